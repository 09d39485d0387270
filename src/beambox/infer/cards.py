"""What is known of a set of weights: the card in its file, its size and its checksum."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beambox.detectors.weights import read_weights

__all__ = ["Card", "CardScores", "card_text", "read_card"]


@dataclass(frozen=True)
class CardScores:
    """What weights score on one data set."""

    data: str
    """Which frames, in words."""
    command: str
    """What repeats the numbers."""
    note: str
    """What is to be kept in mind."""
    values: Mapping[str, str]
    """Numbers by metric, as written by the protocol."""


@dataclass(frozen=True)
class Card:
    """One set of weights."""

    name: str
    """Name of the file without its ending, by which shipped weights are loaded."""
    detector: str
    """Which detector they are for."""
    classes: tuple[str, ...]
    """What it finds."""
    parameters: int
    """Number of values."""
    size: int
    """Bytes of the file."""
    sha256: str
    """Checksum of the file."""
    entries: Mapping[str, Any]
    """The card as it was written: data, recipe, licence, scores; the properties below read it."""

    def __str__(self) -> str:
        """Return the whole card as text."""
        return card_text(self)

    @property
    def summary(self) -> str:
        """What the weights are, in one line."""
        return self._text("summary")

    @property
    def licence(self) -> str:
        """Under which licence the weights stand, and why; empty where the card does not say."""
        return self._text("licence")

    @property
    def trained_on(self) -> str:
        """Which data the weights saw."""
        return self._text("trained on")

    @property
    def training(self) -> str:
        """How long the training took, and on what."""
        return self._text("training")

    @property
    def recipe(self) -> str:
        """Which recipe makes the weights again."""
        return self._text("recipe")

    @property
    def weak_at(self) -> str:
        """What the weights are known to do badly."""
        return self._text("weak at")

    @property
    def protocol(self) -> str:
        """How the scores were computed: benchmark, metric, unit."""
        scores = self.entries.get("scores")
        return str(scores.get("protocol", "")) if isinstance(scores, Mapping) else ""

    @property
    def scores(self) -> tuple[CardScores, ...]:
        """What the weights score, one entry for each data set."""
        scores = self.entries.get("scores")
        if not isinstance(scores, Mapping):
            return ()
        sets = [(str(name), entry) for name, entry in scores.items() if isinstance(entry, Mapping)]
        return tuple(
            CardScores(
                data=name,
                command=str(entry.get("command", "")),
                note=str(entry.get("note", "")),
                values={str(key): str(value) for key, value in entry.items() if key not in ("command", "note")},
            )
            for name, entry in sets
        )

    def _text(self, key: str) -> str:
        value = self.entries.get(key, "")
        return (
            value if isinstance(value, str) else ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        )

    def line(self) -> str:
        """One line for a list."""
        head = f"{self.name}: {self.detector}, {', '.join(self.classes)}; {self.size / 1e6:.1f} MB"
        words = [str(self.entries[key]) for key in ("summary", "licence") if key in self.entries]
        return "; ".join([head, *words])

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values."""
        return {
            "name": self.name,
            "detector": self.detector,
            "classes": list(self.classes),
            "parameters": self.parameters,
            "bytes": self.size,
            "sha256": self.sha256,
            "card": dict(self.entries),
        }


def read_card(path: Path) -> Card:
    """Read what a weight file says of itself.

    Raises:
        BeamboxError: if it is not a weight file.
    """
    stored = read_weights(path)
    content = path.read_bytes()
    return Card(
        name=path.stem,
        detector=stored.detector,
        classes=_classes(stored.config),
        parameters=sum(value.numel() for value in stored.tensors.values()),
        size=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
        entries=stored.card,
    )


def card_text(card: Card) -> str:
    """Write a card out for a terminal."""
    head = {
        "detector": card.detector,
        "classes": ", ".join(card.classes),
        "parameters": f"{card.parameters:,}",
        "file": f"{card.size / 1e6:.2f} MB, sha256 {card.sha256}",
    }
    return "\n".join([card.name, *_lines({**head, **card.entries}, 2)])


def _lines(values: Mapping[str, Any], indent: int) -> list[str]:
    out = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            out += [f"{' ' * indent}{key}:", *_lines(value, indent + 2)]
        else:
            shown = ", ".join(map(str, value)) if isinstance(value, list) else value
            out.append(f"{' ' * indent}{key}: {shown}")
    return out


def _classes(config: Mapping[str, Any]) -> tuple[str, ...]:
    """Read the names of the classes, which configurations keep with their anchors or by themselves."""
    if "classes" in config:
        return tuple(config["classes"])
    return tuple(anchor["name"] for anchor in config.get("anchors", ()))
