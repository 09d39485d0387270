"""The cards of the shipped weights say what they are made of, under which licence, and how to repeat their scores."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from beambox.cli.commands import COMMANDS
from beambox.infer.cards import read_card
from beambox.zoo import shipped
from oracles.tiny_detector import tiny_weights


@pytest.mark.parametrize("name", shipped())
def test_a_shipped_card_is_whole_and_typed(name: str) -> None:
    card = read_card(shipped()[name])
    for text in (card.summary, card.licence, card.trained_on, card.training, card.recipe, card.weak_at, card.protocol):
        assert isinstance(text, str) and len(text) > 3
    assert card.licence.split()[0].rstrip(";,") in ("Apache-2.0", "CC-BY-NC-SA-3.0")
    assert ("KITTI" in card.licence) == ("real" in card.trained_on)
    assert card.scores
    for scores in card.scores:
        assert scores.data and scores.values
        words = shlex.split(scores.command)
        assert words[:1] == ["beambox"] and words[1] in COMMANDS and name in words, scores.command
    assert str(card).startswith(name) and card.licence in str(card)


def test_weights_with_a_poor_card_give_empty_texts(tmp_path: Path) -> None:
    card = read_card(tiny_weights(tmp_path, scores="none", licence=["a", 3]))
    assert card.summary == card.recipe == card.protocol == "" and card.scores == () and card.licence == "a, 3"
