"""Options that are words: their enumeration's members or values, and nothing else, from the start."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.catalog import build
from beambox.detectors.dennet import AttentionPosition, CountSet, DenNetConfig, DensityBranch, Normalization, normalized
from beambox.detectors.hcnet import AdaptiveAdjustment, Gate, HCNetConfig, HeightChannelFusion, HeightChannelKind
from beambox.detectors.kassd import ExtraPoint, KamOptions, KamScore, KASSDConfig, KeypointLayout, LamReduce, Neck
from beambox.detectors.kassd.network import LocationAttention, location_attention

CELL = (0.1, 0.1, 0.15)
MAP = torch.ones(1, 4, 2, 2)

MEANT: list[tuple[Callable[[Any], Any], str, Any]] = [
    (lambda word: AdaptiveAdjustment(8, word).gate, "sigmoid", Gate.SIGMOID),
    (lambda word: HeightChannelFusion(8, 4, word).kind, "HA", HeightChannelKind.HEIGHT),
    (lambda word: HCNetConfig(attention=word).attention, "none", HeightChannelKind.NONE),
    (lambda word: HCNetConfig(aam_gate=word).aam_gate, "sigmoid", Gate.SIGMOID),
    (lambda word: DenNetConfig(na_position=word).na_position, "middle", AttentionPosition.MIDDLE),
    (lambda word: DenNetConfig(count_set=word).count_set, "points", CountSet.POINTS),
    (lambda word: DenNetConfig(normalization=word).normalization, "log", Normalization.LOG),
    (lambda word: DensityBranch(count_set=word).count_set, "points", CountSet.POINTS),
    (lambda word: DensityBranch(normalization=word).normalization, "raw", Normalization.RAW),
    (lambda word: KASSDConfig(neck=word).neck, "psa", Neck.PSA),
    (lambda word: KASSDConfig(lam_reduce=word).lam_reduce, "mean", LamReduce.MEAN),
    (lambda word: KamOptions(score=word).score, "multiply", KamScore.MULTIPLY),
    (lambda word: KeypointLayout(extra_point=word).extra_point, "center", ExtraPoint.CENTER),
    (lambda word: LocationAttention(4, 4, reduce=word).reduce, "mean", LamReduce.MEAN),
]


@pytest.mark.parametrize(("make", "word", "member"), MEANT)
def test_a_word_is_its_option_and_another_is_refused(make: Callable[[Any], Any], word: str, member: Any) -> None:
    assert make(word) is member and make(member) is member
    with pytest.raises(BeamboxError, match=rf'must be one of its options, got .*did you mean "{word}"\?'):
        make(word + "x")
    for wrong in (None, 3, ["sum"]):
        with pytest.raises(BeamboxError, match=r"must be one of its options, got .*known: "):
            make(wrong)


def test_functions_take_the_word_too() -> None:
    count = torch.tensor([1, 5])
    torch.testing.assert_close(normalized(count, 0.6, CELL, "log"), torch.log1p(count.float()))
    with pytest.raises(BeamboxError, match=r'`how` must be .* got \'lag\' \(did you mean "log"\?\)'):
        normalized(count, 0.6, CELL, "lag")
    torch.testing.assert_close(
        location_attention(2 * MAP, MAP, "mean"), location_attention(2 * MAP, MAP, LamReduce.MEAN)
    )
    with pytest.raises(BeamboxError, match=r'`reduce` must be .* \(did you mean "mean"\?\)'):
        location_attention(MAP, MAP, "meen")


def test_a_network_built_from_a_word_is_the_meant_one() -> None:
    with torch.device("meta"):
        by_word, by_member = (build("kassd", {"neck": neck}) for neck in ("psa", Neck.PSA))
    assert [n for n, _ in by_word.named_parameters()] == [n for n, _ in by_member.named_parameters()]
    with pytest.raises(BeamboxError, match=r'`neck`: .*got \'pas\' \(did you mean "psa"\?\)'):
        build("kassd", {"neck": "pas"})
