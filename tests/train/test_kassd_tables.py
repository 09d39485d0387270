import re

import pytest
import torch

from beambox.detectors.catalog import config_from_dict
from beambox.detectors.kassd import KASSDConfig, Neck
from beambox.detectors.second import SECONDConfig
from beambox.infer.evaluate import score_frames
from beambox.metrics.kitti import KittiFrame
from beambox.simulate.frames import CAMERA
from beambox.structures import Detections, Labels
from beambox.structures.labels import ImageAttributes
from beambox.train.ablation import row_recipe, value_at
from beambox.train.config import ValidationSection, read_recipe
from beambox.train.tables import Table, table_of
from beambox.train.validate import summarize


def configs(table: Table) -> dict[str, KASSDConfig]:
    recipe = read_recipe(table.recipe)
    by_row = {}
    for row in table.rows:
        assert row.options is not None
        plan = row_recipe(recipe, row.options, 0)
        assert plan.detector.name == "kassd"
        by_row[row.name] = config_from_dict(KASSDConfig, plan.detector.options)
    return by_row


def test_table_6_counts_the_keypoints_its_rows_name() -> None:
    for name, config in configs(table_of("kassd-table6")).items():
        boundary, inner = map(int, re.findall(r"\d+", name))
        assert not config.llm
        found = (config.keypoints.boundary, config.keypoints.inner) if config.kam else (0, 0)
        assert found == (boundary, inner), name


def test_tables_4_and_5_switch_what_their_rows_name() -> None:
    four = configs(table_of("kassd-table4"))
    assert {name: (c.llm, c.kam) for name, c in four.items()} == {
        "neither": (False, False),
        "LLM": (True, False),
        "KAM": (False, True),
        "LLM + KAM": (True, True),
    }
    assert four["LLM + KAM"] == KASSDConfig(), "the recipe spells out the defaults"
    five = configs(table_of("kassd-table5"))
    assert [c.neck for c in five.values()] == [Neck.PSA, Neck.DENSEASPP, Neck.SPP, Neck.LLM]
    assert all(c.kam for c in five.values())


def test_rows_that_two_tables_share_are_one_run() -> None:
    four, six = table_of("kassd-table4"), table_of("kassd-table6")
    assert four.recipe == six.recipe
    shared = [(a.options, b.options) for a in four.rows for b in six.rows if a.published == b.published]
    assert len(shared) == 2
    assert all(a == b for a, b in shared)


def test_table_3_compares_with_second_as_it_is_trained() -> None:
    table = configs(table_of("kassd-table3"))
    of_second = read_recipe("kassd-whut", ["detector.name=second"])  # as docs/kassd.md trains it
    weights = table["SECOND"].loss_weights
    assert (weights.cls, weights.loc, weights.direction) == (1.0, 2.0, 0.2)
    assert not table["SECOND"].llm and not table["SECOND"].kam
    second = config_from_dict(SECONDConfig, of_second.detector.options)
    assert (second.grid, second.anchors) == (table["SECOND"].grid, table["SECOND"].anchors)


@pytest.fixture
def occluded() -> list[KittiFrame]:
    """A frame with a camera and one car that is found, but too hidden for any of KITTI's levels."""
    boxes = torch.tensor([[20.0, 1, -1, 4, 1.7, 1.5, 0.3]])
    hidden = ImageAttributes(torch.zeros(1), torch.tensor([3]), torch.zeros(1), torch.tensor([[500.0, 150, 600, 200]]))
    found = Detections(boxes, torch.ones(1), torch.zeros(1, dtype=torch.int64), ("Car",), "000000")
    return [KittiFrame(Labels(boxes, ("Car",), hidden), found, CAMERA, (1242, 375))]


def test_without_levels_every_object_counts(occluded: list[KittiFrame]) -> None:
    table = table_of("kassd-table3")
    (column,) = table.columns
    recipe = read_recipe(table.recipe)
    assert recipe.validation is not None and recipe.validation.level == "all"
    scores = score_frames(occluded, ("Car",), levels=False)
    assert scores.levels == ("all objects",)
    assert value_at(scores.to_json(), column.path) == pytest.approx(100 / 11, abs=1e-3), "R11 of a single object"
    assert scores["Car"].objects == (1,)
    graded = score_frames(occluded, ("Car",))
    assert graded["Car"].objects == (0, 0, 0)
    section: ValidationSection = recipe.validation.model_copy(update={"recalls": "all"})
    assert summarize(scores, section).value == pytest.approx(100)
