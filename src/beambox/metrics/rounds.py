"""Several overlaps for one class: how they are written, and how their scores stand in one JSON object."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from beambox.checks import BeamboxError

__all__ = ["merge_entries", "parse_rounds", "score_rounds"]


class Result(Protocol):
    """Scores of some classes."""

    def to_json(self) -> Mapping[str, Mapping[str, Any]]:
        """Return an entry per class, with its ``iou``; further entries, such as a mean, have none."""
        ...


R = TypeVar("R")


def parse_rounds(texts: Sequence[str]) -> list[dict[str, float]]:
    """Read overlaps given as ``Car=0.7,Car=0.5``: the first of each class, then the second of those that have one, ...

    Raises:
        BeamboxError: quoting what cannot be read.
    """
    rounds: list[dict[str, float]] = [{}]
    for text in (part.strip() for given in texts for part in given.split(",") if part.strip()):
        name, _, value = (word.strip() for word in text.partition("="))
        try:
            overlap = float(value)
        except ValueError:
            name = ""
        if not name:
            raise BeamboxError(f'--iou takes CLASS=NUMBER pairs, as Car=0.5; got "{text}"')
        free = next((one for one in rounds if name not in one), None)
        if free is None:
            rounds.append(free := {})
        free[name] = overlap
    return rounds


def score_rounds(
    score: Callable[[Sequence[str], Mapping[str, float]], R],
    classes: Sequence[str],
    rounds: Sequence[Mapping[str, float]],
) -> tuple[R, ...]:
    """Score all classes with the first overlaps, then those that have further ones with these.

    Args:
        score: takes classes and the overlaps given for them.
        classes: to score.
        rounds: from :func:`parse_rounds`.
    """
    return tuple(score(list(given) if number else classes, given) for number, given in enumerate(rounds or ({},)))


def merge_entries(results: Sequence[Result]) -> dict[str, dict[str, Any]]:
    """Join the entries of several rounds: ``NAME`` for a class's first overlap, ``NAME@IOU`` for further ones."""
    entries: dict[str, dict[str, Any]] = {}
    for result in results:
        for name, entry in result.to_json().items():
            if name not in entries:
                entries[name] = dict(entry)
            elif "iou" in entry and entry["iou"] != entries[name]["iou"]:
                entries[f"{name}@{entry['iou']:g}"] = dict(entry)
    return entries
