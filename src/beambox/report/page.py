"""The report of one evaluation, or of two side by side, as one HTML file that needs nothing else."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from beambox.metrics.box_errors_result import COLUMNS, BoxErrors
from beambox.metrics.kitti_result import KittiResult
from beambox.report import charts, numbers
from beambox.report.failures import HEADINGS, Picture
from beambox.report.measure import Measured
from beambox.report.tables import ap_rows
from beambox.visualize.page import data_url, fill

__all__ = ["report_html"]


def report_html(
    all_of: Sequence[Measured],
    pictures: Mapping[str, Sequence[Picture]] | None = None,
    *,
    title: str = "",
    links: Mapping[str, str] | None = None,
) -> str:
    """Return the page.

    Args:
        all_of: one evaluation, or two of the same frames; the pictures are of the first.
        pictures: the worst failures of each class.
        title: of the page.
        links: address of a page of each frame, by the frame's name, where there are such pages.
    """
    first = all_of[0]
    name = title or " against ".join(one.name for one in all_of)
    parts = [f"<h1>{escape(name)}</h1>", f"<p>{escape(_summary(first))}</p>", _scores(all_of)]
    parts.append('<nav class="tabs" aria-label="Class">')
    parts += [f'<button type="button" data-class="{escape(each)}">{escape(each)}</button>' for each in first.classes]
    parts.append("</nav>")
    for each in first.classes:
        shown = (pictures or {}).get(each, ())
        parts.append(f'<section data-class="{escape(each)}">')
        parts += [*_class([one for one in all_of if each in one.classes], each), *_pictures(shown, links or {})]
        parts.append("</section>")
    parts += [_confusion(all_of), *(_about(one) for one in all_of)]
    page = Path(__file__).with_name("report.html").read_text(encoding="utf-8")
    return fill(page, {"TITLE": escape(name), "CONTENT": "\n".join(parts)})


def _summary(one: Measured) -> str:
    objects = sum(int(one.matches.truth.counts[one.matches.truth.name == name].sum()) for name in one.classes)
    return f"{len(one.frames)} frames, {objects} objects that count, {len(one.matches.found.name)} detections"


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Write a table; cells are text, or begin with ``<td`` where they bring their own element."""
    lines = [
        "<div class='scroll'><table><thead><tr>",
        *(f"<th>{escape(each)}</th>" for each in head),
        "</tr></thead><tbody>",
    ]
    for row in rows:
        cells = (cell if isinstance(cell, _Cell) else f"<td>{escape(cell)}</td>" for cell in row)
        lines.append("<tr>" + "".join(cells) + "</tr>")
    return "".join(lines) + "</tbody></table></div>"


class _Cell(str):
    """A cell with its element, already escaped."""


def _cell(text: str, kind: str) -> _Cell:
    return _Cell(f'<td class="{kind}">{escape(text)}</td>')


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"


def _change(new: float, old: float) -> _Cell:
    if math.isnan(new) or math.isnan(old):
        return _cell("-", "same")
    return _cell(f"{new - old:+.2f}", "up" if new > old else "down" if new < old else "same")


# ---------------------------------------------------------------- official scores


def _scores(all_of: Sequence[Measured]) -> str:
    """Write a table per class: a row per metric, the levels or bands side by side."""
    first = all_of[0]
    kitti = isinstance(first.scored, KittiResult)
    notes = first.scored.table().splitlines()[: 3 if kitti else 2]
    parts = ["<h2>Average precision</h2><p>", "<br>".join(escape(line) for line in notes), "</p>"]
    if not isinstance(first.scored, KittiResult) or len(first.scored.levels) > 1:
        parts.append("<p>On grey, in bold: the number that papers quote.</p>")
    if kitti and _capped(first):
        parts.append(f"<p>{escape(_capped(first))}</p>")
    for name in first.classes:
        iou, objects = _protocol(first, name)
        parts.append(f"<h3>{escape(name)}, IoU &gt; {iou:.2f}, {objects} objects</h3>")
        parts.append(_ap_table(all_of, name))
    return "".join(parts)


def _ap_table(all_of: Sequence[Measured], name: str) -> str:
    tables = [
        {(metric, level): value for n, metric, cells in ap_rows(one) if n == name for level, value in cells}
        for one in all_of
    ]
    columns: dict[str, None] = {}  # "R40 easy", ...
    metrics: dict[str, None] = {}
    for metric, level in tables[0]:
        what, _, kind = metric.partition(" ")
        metrics[what], columns[f"{kind} {level}".strip()] = None, None
    kinds = {column: column.split(" ", 1) for column in columns}
    rows: list[list[str]] = []
    for metric in metrics:
        keys = [(f"{metric} {kind[0]}", kind[1]) if len(kind) == 2 else (metric, kind[0]) for kind in kinds.values()]
        for one, table in zip(all_of, tables):
            cells = []
            for key in keys:
                text, quoted = _percent(table.get(key, math.nan)), key in (("3d R40", "moderate"), ("AP", "overall"))
                cells.append(_cell(text, "quoted") if quoted else text)
            rows.append([metric, *([one.name] if len(all_of) > 1 else []), *cells])
        if len(all_of) > 1:
            changes = [_change(tables[0].get(key, math.nan), tables[1].get(key, math.nan)) for key in keys]
            rows.append(["", "first - second", *changes])
    return _table(["", *(["detector"] if len(all_of) > 1 else []), *columns], rows)


def _protocol(one: Measured, name: str) -> tuple[float, str]:
    if isinstance(one.scored, KittiResult):
        return one.scored[name].iou, " / ".join(map(str, one.scored[name].objects))
    place = one.scored.classes.index(name)
    return one.scored.iou[place], str(one.scored.objects[place][0])


def _capped(one: Measured) -> str:
    assert isinstance(one.scored, KittiResult)
    few = [result.name for result in one.scored.classes if 0 < min(result.objects) < 41]
    return f"Fewer than 41 objects of {', '.join(few)}: R40 and R11 are capped there, read `all`." if few else ""


# ---------------------------------------------------------------- one class


def _class(all_of: Sequence[Measured], name: str) -> list[str]:
    drawn = (charts.curves_chart, charts.score_chart, charts.calibration_chart)
    official = isinstance(all_of[0].scored, KittiResult)
    curve = "3-D, the official interpolation at 41 recalls (R40)" if official else "3-D IoU alone, over every recall"
    return [
        f"<h2>{escape(name)}</h2>",
        f"<p>Precision and recall: {curve}. Scores: how many detections are right and wrong. Calibration: on the "
        "diagonal, a score is the share of right detections; the error is the mean distance from it (ECE).</p>",
        '<div class="charts">',
        *(_image(chart(all_of, name), f"{chart.__name__} of {name}") for chart in drawn),
        "</div>",
        _working_points(all_of, name),
        "<h3>By distance, occlusion and number of points</h3>",
        "<p>AP over every recall, 3-D. Objects outside a group are ignored; wrong detections count in every group, by "
        "distance those at that distance alone.</p>",
        '<div class="charts">',
        _image(charts.group_chart(all_of, name), f"AP by group of {name}"),
        "</div>",
        _groups(all_of, name),
        "<h3>Errors of the boxes found</h3>",
        "<p>Detected minus labelled, over pairs with a BEV IoU above 0.25: mean ± spread. range: away from the sensor; "
        "along, across: forward and left in the object's own frame. ATE, ASE, AOE by nuScenes' rule (2 m).</p>",
        '<div class="charts">',
        _image(charts.error_chart(all_of, name), f"signed errors of {name}"),
        "</div>",
        *(_errors(one.name if len(all_of) > 1 else "", one.errors, name) for one in all_of),
    ]


def _image(svg: bytes, what: str) -> str:
    return f'<img src="{data_url(svg, "image/svg+xml")}" alt="{escape(what)}">'


def _working_points(all_of: Sequence[Measured], name: str) -> str:
    rows = []
    for one in all_of:
        point = numbers.working_point(one.matches, name)
        score = "-" if math.isnan(point.score) else f"{point.score:.3f}"
        rows.append([one.name, score, *map(_percent, (point.precision, point.recall, point.f1))])
    head = ("best F1", "at score", "precision %", "recall %", "F1 %")
    return _table(head, rows)


def _groups(all_of: Sequence[Measured], name: str) -> str:
    head = ["group", "objects", *(f"{what}{_of(all_of, one)}" for one in all_of for what in ("AP", "recall"))]
    both = [numbers.groups(one.matches, name) for one in all_of]
    rows = []
    for k, group in enumerate(both[0]):
        cells = [text for each in both if k < len(each) for text in (_percent(each[k].ap), _percent(each[k].recall))]
        label = f"{group.name} points" if group.by == "points" else group.name
        rows.append([label, str(group.objects), *cells])
    return _table(head, rows)


def _of(all_of: Sequence[Measured], one: Measured) -> str:
    return f", {one.name}" if len(all_of) > 1 else ""


def _errors(prefix: str, errors: BoxErrors, name: str) -> str:
    mine = errors[name]
    rows = []
    for band in mine.bands:
        cells = []
        for column in COLUMNS:
            factor = 180 / math.pi if column == "heading" else 100
            mean, spread = factor * band.mean[column], factor * band.spread[column]
            cells.append("-" if math.isnan(mean) else f"{mean:+.1f} ± {spread:.1f}")
        rows.append([band.name, f"{band.matched}/{band.objects}", *cells])
    head = [prefix or "distance", "found", *(f"{c} {'°' if c == 'heading' else 'cm'}" for c in COLUMNS)]
    remarks = [
        f"{key} {'-' if math.isnan(v) else f'{v:.3f}'}"
        for key, v in (("ATE", mine.ate), ("ASE", mine.ase), ("AOE", mine.aoe))
    ]
    flipped = "-" if math.isnan(mine.flipped) else f"{mine.flipped:.1f}"
    return _table(head, rows) + f"<p>{', '.join(remarks)}; {flipped} % point the other way</p>"


def _pictures(pictures: Sequence[Picture], links: Mapping[str, str]) -> list[str]:
    parts = []
    for kind, heading in HEADINGS.items():
        some = [picture for picture in pictures if picture.failure.kind == kind]
        if not some:
            continue
        parts += [f"<h3>{escape(heading)}</h3>", '<div class="pictures">']
        for picture in some:
            frame = escape(picture.frame_id)
            link = links.get(picture.frame_id)
            named = f'<a href="{escape(link)}">frame {frame}</a>' if link else f"frame {frame}"
            images = [f'<img src="{data_url(picture.bev, "image/jpeg")}" alt="from above" loading="lazy">']
            if picture.camera is not None:
                images.append(f'<img src="{data_url(picture.camera, "image/jpeg")}" alt="camera" loading="lazy">')
            text = escape(picture.failure.text)
            parts.append(
                f'<figure>{"".join(images)}<figcaption>{named}<p class="note">{text}</p></figcaption></figure>'
            )
        parts.append("</div>")
    if parts:
        parts.insert(
            0, "<p>Pictures: x forward is up, labels dashed green, detections in the colour of their class.</p>"
        )
    return parts


# ---------------------------------------------------------------- all classes


def _confusion(all_of: Sequence[Measured]) -> str:
    parts = [
        "<h2>Confusion</h2><p>Above each class's best F1. Rows: labelled; columns: detected. An object detected as "
        "another class counts as not found, too.</p>"
    ]
    for one in all_of:
        table = numbers.confusion(one.matches)
        head = [one.name, *table.classes, "not found"]
        rows = [[label, *map(str, row)] for label, row in zip((*table.classes, "background"), table.counts)]
        rows[-1][-1] = ""
        parts.append(_table(head, rows))
    return "".join(parts)


def _about(one: Measured) -> str:
    plain = {key: value for key, value in one.about.items() if not isinstance(value, Mapping)}
    nested = {key: value for key, value in one.about.items() if isinstance(value, Mapping)}
    parts = [f"<h2>{escape(one.name)}: how it was made</h2>", _list(plain)]
    for key, value in nested.items():
        parts.append(f"<details><summary>{escape(key)}</summary>{_list(value)}</details>")
    return "".join(parts)


def _list(values: Mapping[str, Any]) -> str:
    if not values:
        return ""
    rows = []
    for key, value in values.items():
        shown = _list(value) if isinstance(value, Mapping) else escape(_words(value))
        rows.append(f"<dt>{escape(str(key))}</dt><dd>{shown}</dd>")
    return f"<dl>{''.join(rows)}</dl>"


def _words(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
