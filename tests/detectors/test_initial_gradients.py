"""A fresh network learns everywhere: no ReLU is shut for good, no gate is cut off, and priors hold, over 40 seeds."""

from __future__ import annotations

import pytest
import torch

from beambox.detectors.catalog import build
from beambox.detectors.hcnet import HeightChannelFusion, HeightChannelKind
from beambox.detectors.kassd import KASSDConfig, LamReduce, kassd
from beambox.detectors.kassd.network import LocationAttention
from beambox.train.recipes import list_recipes
from beambox.train.stages import read_stages

SEEDS = range(40)


def crowded_map(channels: int, seed: int, size: int = 8) -> torch.Tensor:
    """A map as an encoder gives it: nothing below 0, most places empty."""
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(2, channels, size, size, generator=generator).relu()
    return values * (torch.rand(2, 1, size, size, generator=generator) < 0.3)


def test_hcnets_attention_is_open_in_every_slice_and_channel() -> None:
    for seed in SEEDS:
        torch.manual_seed(seed)
        module = HeightChannelFusion(64, 4, HeightChannelKind.BOTH)
        stacks = torch.randn(500, 4, 64).relu() * (torch.rand(500, 4, 1) < 0.4)
        module(stacks).square().sum().backward()
        for branch, of in ((module.height, stacks.amax(dim=2)), (module.channel, stacks.amax(dim=1))):
            assert branch is not None
            given = branch(of)
            assert bool((given.amax(dim=0) > 0).all()), f"seed {seed}: a slice or channel is always 0"
            for name, parameter in branch.named_parameters():
                of_unit = parameter.grad.flatten(1).abs().sum(1) if parameter.dim() > 1 else parameter.grad.abs()
                assert bool((of_unit > 0).all()), f"seed {seed}: a unit of {name} gets no gradient"


@pytest.mark.parametrize("width", [32, 128])
def test_both_levels_of_lam_learn_from_the_start(width: int) -> None:
    for seed in SEEDS if width == 32 else range(4):
        torch.manual_seed(seed)
        module = LocationAttention(64, width)
        out = module(crowded_map(64, seed))
        (out * torch.randn_like(out)).sum().backward()
        high, low = (level[0].weight.grad.norm() for level in (module.levels.up_high, module.levels.up_low))
        assert 0.1 < float(high / low) < 10, f"seed {seed}: gradients of F3 and F4 are {high:.3g} and {low:.3g}"
        assert float(module.levels.reduce[0].weight.grad.norm()) > 0


def test_other_sums_of_levels_start_as_pytorch_does() -> None:
    torch.manual_seed(0)
    for module in (LocationAttention(8, 8, lam=False), LocationAttention(8, 8, reduce=LamReduce.MEAN)):
        assert bool((module.levels.reduce[1].weight == 1).all())


def test_kassds_priors_hold_behind_llm() -> None:
    model = kassd(KASSDConfig())
    for seed in range(4):
        torch.manual_seed(seed)
        bev = model.neck(crowded_map(256, seed))
        with torch.no_grad():
            maps = torch.nn.functional.conv2d(bev, model.head.cls.weight, model.head.cls.bias), model.kam(bev)
        for logits in maps:
            low, high = torch.sigmoid(logits).flatten().quantile(torch.tensor([0.01, 0.99])).tolist()
            assert 0.005 < low and high < 0.02


@pytest.mark.parametrize("name", [recipe.name for recipe in list_recipes() if recipe.name.startswith("kassd")])
def test_kam_learns_the_overlap_at_which_it_is_scored(name: str) -> None:
    recipe = read_stages(name)[-1]
    if recipe.validation is None:
        pytest.skip("it is scored at several overlaps, by commands of its page")
    config = build(recipe.detector.name, recipe.detector.options).config
    official = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
    scored = [recipe.validation.iou.get(of_class, official[of_class]) for of_class in config.classes]
    taught = config.kam_options.positive_iou
    assert [*(taught * len(scored))[: len(scored)]] == scored
