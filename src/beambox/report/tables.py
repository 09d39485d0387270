"""The numbers of evaluations for other programs and for papers: CSV, LaTeX, JSON."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from beambox import __version__
from beambox.checks import BeamboxError
from beambox.io import write_json, write_text
from beambox.metrics.box_errors_result import COLUMNS
from beambox.metrics.once_result import BANDS, OnceResult
from beambox.report import numbers
from beambox.report.measure import Measured

__all__ = ["ENDINGS", "ap_rows", "latex", "numbers_csv", "write_numbers"]

ENDINGS = (".json", ".csv", ".tex")
CSV_COLUMNS = ("evaluation", "class", "metric", "group", "value", "unit")

Row = tuple[str, str, str, str, float | None, str]


def ap_rows(one: Measured) -> list[tuple[str, str, list[tuple[str, float]]]]:
    """Return (class, metric, [(level or band, AP in percent)]) of an evaluation; NaN where nothing was scored."""
    scored = one.scored
    if isinstance(scored, OnceResult):
        return [(name, "AP", list(zip(BANDS, row))) for name, row in zip(scored.classes, scored.ap)]
    out = []
    for result in scored.classes:
        for metric, averages in result.metrics():
            for kind in ("r40", "r11", "all_points"):
                label = f"{metric} {'all' if kind == 'all_points' else kind.upper()}"
                out.append((result.name, label, [(n, getattr(a, kind)) for n, a in zip(scored.levels, averages)]))
    return out


def _rows(one: Measured) -> Iterator[Row]:
    for name, metric, cells in ap_rows(one):
        for level, value in cells:
            yield one.name, name, f"AP {metric}", level, _known(value), "percent"
    for errors in one.errors.classes:
        for band in errors.bands:
            for column in COLUMNS:
                unit = "rad" if column == "heading" else "m"
                yield one.name, errors.name, f"error {column} mean", band.name, _known(band.mean[column]), unit
                yield one.name, errors.name, f"error {column} spread", band.name, _known(band.spread[column]), unit
        for key, value, unit in (("ATE", errors.ate, "m"), ("ASE", errors.ase, "1 - IoU"), ("AOE", errors.aoe, "rad")):
            yield one.name, errors.name, key, "overall", _known(value), unit
    for name in one.classes:
        for group in numbers.groups(one.matches, name):
            yield one.name, name, f"AP by {group.by}", group.name, _known(group.ap), "percent"
            yield one.name, name, f"recall by {group.by}", group.name, _known(group.recall), "percent"
            yield one.name, name, f"objects by {group.by}", group.name, float(group.objects), "count"
        point = numbers.working_point(one.matches, name)
        for key, value in vars(point).items():
            yield one.name, name, f"working point {key}", "overall", _known(value), "" if key == "score" else "percent"
        yield (
            one.name, name, "calibration error", "overall",
            _known(numbers.calibration(one.matches, name).error), "percent",
        )  # fmt: skip


def numbers_csv(all_of: Sequence[Measured]) -> str:
    """Return every number in a row of its own, with a header line; an empty value where there is none."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for one in all_of:
        for *words, value, unit in _rows(one):
            writer.writerow([*words, "" if value is None else f"{value:.6g}", unit])
    return text.getvalue()


def latex(all_of: Sequence[Measured]) -> str:
    """Return the AP as a LaTeX table (package booktabs): a row an evaluation, for each class and metric."""
    lines = [f"% written by beambox {__version__}; AP in percent"]
    first = ap_rows(all_of[0])
    wanted = [
        (name, metric) for name, metric, _ in first if not metric.startswith(("2d", "aos")) and "all" not in metric
    ]
    wanted = wanted or [(name, metric) for name, metric, _ in first]
    levels = [level for level, _ in first[0][2]] if first else []
    lines += [r"\begin{tabular}{lll" + "r" * len(levels) + "}", r"\toprule"]
    lines += [" & ".join(["Class", "Metric", "Detector", *map(_escape, levels)]) + r" \\", r"\midrule"]
    for name, metric in wanted:
        for one in all_of:
            cells = next((row for n, m, row in ap_rows(one) if (n, m) == (name, metric)), [])
            values = {level: "--" if math.isnan(value) else f"{value:.2f}" for level, value in cells}
            row = [_escape(name), _escape(metric), _escape(one.name), *(values.get(level, "--") for level in levels)]
            lines.append(" & ".join(row) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def write_numbers(path: Path, all_of: Sequence[Measured]) -> None:
    """Write the numbers as the file's ending says: .json, .csv or .tex.

    Raises:
        BeamboxError: for another ending.
    """
    check_ending(path)
    if path.suffix == ".json":
        content: Any = [one.to_json() for one in all_of]
        write_json(path, {"beambox": __version__, "evaluations": content})
    else:
        write_text(path, numbers_csv(all_of) if path.suffix == ".csv" else latex(all_of))


def check_ending(path: Path) -> None:
    """Refuse a name whose ending says no known form, before anything is measured."""
    if path.suffix not in ENDINGS:
        raise BeamboxError(f"numbers are written as {', '.join(ENDINGS)}, got the name {path}")


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _escape(text: str) -> str:
    """Write text so that LaTeX prints it as it is."""
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(special.get(letter, f"\\{letter}" if letter in "&%$#_{}" else letter) for letter in text)
