from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer import Typer
from typer.testing import CliRunner

from beambox.checks import BeamboxError
from beambox.cli import ablate
from beambox.data.database import ObjectDatabase
from beambox.data.source import FrameSource
from beambox.detectors.catalog import CATALOG, config_from_dict
from beambox.metrics.kitti_result import AveragePrecision, ClassResult, KittiResult
from beambox.train import ablation
from beambox.train.ablation import Interrupted, Timed, merged, report, row_recipe, run_table, to_json, value_at
from beambox.train.config import Recipe, parse_recipe, read_recipe
from beambox.train.sources import open_source, shared_database
from beambox.train.table_file import read_table
from beambox.train.tables import TABLES, Column, Row, Table, levels, table_of
from oracles import tiny_training

ROOT = Path(__file__).resolve().parents[2]
COLUMNS = (
    Column("Car 3-D all", "any", ("Car", "3d", "all", 0)),
    Column("Car BEV all", "any", ("Car", "bev", "all", 0)),
)
TINY = Table(
    title="a table",
    protocol="a paper's data",
    recipe="tiny",
    columns=COLUMNS,
    rows=(
        Row("quoted", (50.0, None)),
        Row("centred", (60.0, 70.0), {"centered_anchors": True}),
        Row("plain", (61.0, 71.0), {}),
    ),
    remarks=("a remark",),
)

LESS = ({"kind": "kitti", "frames": 2},)


def tiny_recipe() -> Recipe:
    plain = tiny_training.recipe(iterations=2).model_dump(mode="python")
    return parse_recipe({**plain, "validation": {"source": {"kind": "kitti", "split": "val"}}})


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Sources are frames in memory; returns the splits that were opened."""
    splits: list[str] = []

    def in_memory(section: Any, data: Path | None) -> FrameSource:
        splits.append(section.split)
        return tiny_training.frames(3, seed=len(section.split))

    monkeypatch.setattr("beambox.train.loop.open_source", in_memory)
    monkeypatch.setattr("beambox.train.ablation.open_source", in_memory)
    return splits


def test_every_row_is_trained_for_every_seed_and_nothing_twice(tmp_path: Path, opened: list[str]) -> None:
    messages: list[str] = []
    measured = run_table(TINY, tiny_recipe(), None, tmp_path, [0, 1], messages.append)
    assert {name: len(runs) for name, runs in measured.items()} == {"centred": 2, "plain": 2}
    assert all(len(run) == 2 and all(v is not None for v in run) for runs in measured.values() for run in runs)
    assert [line.split(":")[0] for line in messages] == [
        "row centred, seed 0 (1 of 4)",
        "row centred, seed 1 (2 of 4)",
        "row plain, seed 0 (3 of 4)",
        "row plain, seed 1 (4 of 4)",
    ]
    assert opened == ["val", "train", "train", "train", "train"]
    again = run_table(TINY, tiny_recipe(), None, tmp_path, [0, 1], messages.append)
    assert again == measured
    assert opened[5:] == ["val"]


def test_once_is_scored_by_its_own_rules(tmp_path: Path, opened: list[str]) -> None:
    plain = tiny_recipe().model_dump(mode="python")
    plain["validation"]["source"]["kind"] = "once"
    columns = (Column("Vehicle", "overall", ("Vehicle", "overall")), Column("mAP", "overall", ("mean", "overall")))
    table = replace(TINY, columns=columns, rows=(Row("plain", (60.0, 50.0), {}),))
    ((run,),) = run_table(table, parse_recipe(plain), None, tmp_path, [0], lambda _: None).values()
    scores = json.loads((tmp_path / "tiny" / "as-recipe" / "seed-0" / "scores.json").read_text())
    assert set(scores) == {"Vehicle", "Pedestrian", "Cyclist", "mean", "time"}
    assert run == [scores["Vehicle"]["overall"], scores["mean"]["overall"]]


def test_the_once_recipe_reads_the_layout_of_once(tmp_path: Path) -> None:
    run_recipe = read_recipe("hcnet-once")
    with pytest.raises(BeamboxError, match=r"must hold the folder data/ \(ONCE's layout\)"):
        open_source(run_recipe.data[0], tmp_path)


def test_rows_of_a_seed_start_from_the_same_random_numbers(tmp_path: Path, opened: list[str]) -> None:
    run_table(TINY, tiny_recipe(), None, tmp_path, [0, 1], lambda _: None)
    logs = {path.parent.name: path.read_text() for path in (tmp_path / "tiny" / "as-recipe").glob("*/log.jsonl")}
    assert len(logs) == 2
    stored = json.loads((tmp_path / "tiny" / "as-recipe" / "seed-1" / "recipe.json").read_text())
    assert stored["seed"] == 1
    assert stored["validation"] is None


def test_an_interrupted_run_goes_on(tmp_path: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    resumed: list[bool] = []

    def stopped(*args: Any, resume: bool, **rest: Any) -> Any:
        resumed.append(resume)
        outcome = train(*args, resume=resume, **rest)
        return replace(outcome, finished=len(resumed) > 1)

    train = ablation.train
    monkeypatch.setattr(ablation, "train", stopped)
    with pytest.raises(Interrupted):
        run_table(TINY, tiny_recipe(), None, tmp_path, [0], lambda _: None)
    folder = next((tmp_path / "tiny").iterdir()) / "seed-0"
    (folder / "final.safetensors").unlink()  # a stopped run has a checkpoint and no final weights
    run_table(TINY, tiny_recipe(), None, tmp_path, [0], lambda _: None)
    assert resumed[:2] == [False, True]


@pytest.fixture
def cut(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sources of objects are in memory too; returns the number of frames of each that was cut up."""
    lengths: list[int] = []

    def in_memory(section: Any, data: Path | None) -> FrameSource:
        return tiny_training.frames(section.frames or 3)

    def counted(source: FrameSource, *rest: Any) -> ObjectDatabase:
        lengths.append(len(source))
        return build(source, *rest)

    build = ObjectDatabase.build
    monkeypatch.setattr("beambox.train.sources.open_source", in_memory)
    monkeypatch.setattr("beambox.train.sources.ObjectDatabase.build", counted)
    return lengths


def test_objects_are_cut_once_for_all_rows_and_seeds(tmp_path: Path, opened: list[str], cut: list[int]) -> None:
    plain = tiny_recipe().model_dump(mode="python")
    sampling = parse_recipe({**plain, "augment": {"sample": {"Car": 1}}})
    run_table(TINY, sampling, tmp_path, tmp_path / "out", [0, 1], lambda _: None)
    assert cut == [3]
    assert len(list((tmp_path / "out").rglob("*.npz"))) == 1
    run_table(TINY, sampling, tmp_path, tmp_path / "out", [2], lambda _: None)
    assert cut == [3]
    shorter = parse_recipe({**plain, "name": "shorter", "augment": {"sample": {"Car": 1}}, "data": LESS})
    run_table(TINY, shorter, tmp_path, tmp_path / "out", [0], lambda _: None)
    assert cut == [3, 2]


def test_shared_objects_are_named_by_what_they_depend_on(tmp_path: Path, cut: list[int]) -> None:
    def name(folder: str = "a", **changes: Any) -> Path | None:
        plain = tiny_recipe().model_dump(mode="python") | {"augment": {"sample": {"Car": 1}}} | changes
        return shared_database(parse_recipe(plain), tmp_path / folder, tmp_path)

    first = name()
    assert first is not None
    assert first.parent == tmp_path
    same = [name(seed=3), name(augment={"sample": {"Car": 9}, "rotation": 0.1}), name("b/../a")]
    assert same == [first] * 3
    others = [
        name("b"),
        name(data=LESS),
        name(augment={"sample": {"Car": 1, "Van": 1}}),
        name(augment={"sample": {"Van": 1, "Car": 1}}),
        name(augment={"sample": {"Car": 1}, "object_min_points": 9}),
    ]
    assert len({first, *others}) == 6
    assert name(augment=None) is None


def test_runs_of_another_recipe_are_not_taken_for_these(tmp_path: Path, opened: list[str]) -> None:
    run_table(TINY, tiny_recipe(), None, tmp_path, [0], lambda _: None)
    other = tiny_recipe().model_copy(update={"ema": None})
    with pytest.raises(BeamboxError, match=r"holds a run of another recipe \(its `ema` differs\); remove it or give"):
        run_table(TINY, other, None, tmp_path, [0], lambda _: None)


def test_what_cannot_be_run_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without = tiny_recipe().model_copy(update={"validation": None})
    with pytest.raises(BeamboxError, match="recipe tiny has no `validation`, whose source a table is scored on"):
        run_table(TINY, without, None, tmp_path, [0])
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(BeamboxError, match="ablate runs in one process"):
        run_table(TINY, tiny_recipe(), None, tmp_path, [0])


def test_switches_are_laid_over_the_recipes_options() -> None:
    base = {"a": 1, "inner": {"x": 1, "y": 2}}
    assert merged(base, {"inner": {"y": 3}, "b": 4}) == {"a": 1, "inner": {"x": 1, "y": 3}, "b": 4}
    assert base == {"a": 1, "inner": {"x": 1, "y": 2}}
    run_recipe = row_recipe(tiny_recipe(), {"centered_anchors": True}, 7)
    assert run_recipe.detector.options == {**tiny_training.OPTIONS, "centered_anchors": True}
    assert run_recipe.seed == 7


def test_folders_tell_switches_apart() -> None:
    names = [ablation.folder_name(o) for o in ({}, {"a": "HA"}, {"a": "CA"}, {"a": True}, {"a": 1}, {"b": {"c": [1]}})]
    assert names[0] == "as-recipe"
    assert names[1].startswith("a=HA_")
    assert len(set(names)) == len(names)


def test_report_keeps_the_papers_numbers_and_ours_on_lines_of_their_own() -> None:
    measured: ablation.Measured = {"centred": [[1.0, 2.0], [3.0, 4.0]], "plain": [[5.0, None], [6.0, 7.0]]}
    assert report(TINY, measured, "3 frames").splitlines() == [
        "a table",
        "paper: a paper's data",
        "a remark",
        "ours:  3 frames",
        "       compare differences between rows: data and length of training may not be the paper's",
        "",
        "                Car 3-D all  Car BEV all",
        "                        any          any",
        "quoted   paper        50.00            -",
        "centred  paper        60.00        70.00",
        "          ours         2.00         3.00",
        "            +-         1.41         1.41",
        "plain    paper        61.00        71.00",
        "          ours         5.50            -",
        "            +-         0.71            -",
    ]
    alone = report(TINY, {})
    assert "ours" not in alone


def test_json_keeps_them_apart_too() -> None:
    written = to_json(TINY, {"plain": [[1.0, None]]}, tiny_recipe(), [3])
    assert written["columns"] == ["Car 3-D all any", "Car BEV all any"]
    assert written["seeds"] == [3]
    assert written["rows"][2] == {"name": "plain", "options": {}, "paper": [61.0, 71.0], "ours": [[1.0, None]]}
    assert written["rows"][0] == {"name": "quoted", "options": None, "paper": [50.0, None], "ours": []}
    json.dumps(written)


def test_columns_find_their_numbers_in_a_kitti_result() -> None:
    def averages(first: float) -> tuple[AveragePrecision, ...]:
        return tuple(AveragePrecision(first + i, first + 10 + i, 0.0, ()) for i in range(3))

    car = ClassResult("Car", 0.7, (9, 9, 9), averages(10), averages(30), averages(50), averages(70))
    scores = {**KittiResult((car,), ("easy", "moderate", "hard"), 5).to_json(), "time": {"ms": 32.0}}
    table = table_of("hcnet-table2")
    found = [value_at(scores, column.path) for column in table.columns]
    assert found == [30, 31, 32, 10, 11, 12, 70, 71, 72, 32.0]
    assert [value_at(scores, c.path) for c in levels("Car", "3d", "R11")] == [20, 21, 22]
    assert value_at(scores, ("Cyclist", "3d", "R11", 0)) is None


def test_columns_find_their_numbers_in_a_once_result() -> None:
    scores = {
        **{
            name: {"overall": ap, "0-30m": 99.0}
            for name, ap in (("Vehicle", 1.0), ("Pedestrian", 2.0), ("Cyclist", 6.0))
        },
        "mean": {"overall": 3.0},
        "time": {"ms": 40.0},
    }
    found = [value_at(scores, column.path) for column in table_of("dennet-table4").columns]
    assert found == [1.0, 2.0, 6.0, 3.0, 40.0]


def test_time_is_told_after_warming_up(monkeypatch: pytest.MonkeyPatch) -> None:
    timer = iter([0.0, 9.0, 10.0, 19.0, 20.0, 29.0, 30.0, 30.002, 40.0, 40.004, 50.0, 50.009])
    monkeypatch.setattr("beambox.train.ablation.time.perf_counter", lambda: next(timer))
    timed = Timed(lambda frames: [])
    assert timed.median() is None
    for _ in range(6):
        timed([])
    assert timed.median() == pytest.approx(4.0)


@pytest.mark.parametrize("name", TABLES)
def test_tables_name_a_recipe_of_ours_and_options_that_exist(name: str) -> None:
    table = TABLES[name]
    run_recipe = read_recipe(table.recipe)
    assert run_recipe.validation is not None
    configs = []
    for row in table.rows:
        assert len(row.published) == len(table.columns)
        if row.options is not None:
            options = row_recipe(run_recipe, row.options, 0).detector.options
            configs.append(config_from_dict(CATALOG[run_recipe.detector.name].config, options))
    assert configs
    assert len({repr(config) for config in configs}) == len(configs), "two rows with the same switches"


def test_a_wrong_name_is_answered_with_the_nearest() -> None:
    with pytest.raises(BeamboxError, match=r'there is no table "hcnet-tabel3" \(did you mean "hcnet-table3"\?\)'):
        table_of("hcnet-tabel3")


def run_command(*words: str) -> Any:
    app = Typer()
    app.command()(ablate.command)
    return CliRunner().invoke(app, list(words))


def test_published_numbers_can_be_read_without_training() -> None:
    printed = run_command("hcnet-table4", "--published")
    assert printed.exit_code == 0
    assert "OIFM        paper     88.32     78.08     76.52" in printed.output
    assert "Car 3-D R11" in printed.output


def test_the_command_trains_and_prints(tmp_path: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TABLES, "tiny", TINY)
    monkeypatch.chdir(tmp_path)
    Path("tiny.yaml").write_text(json.dumps(tiny_recipe().model_dump(mode="json")), encoding="utf-8")
    words = ["--recipe", "tiny.yaml", "--seeds", "0,4", "--iterations", "1", "--set", "optim.batch=1"]
    done = run_command("tiny", *words, "--json", "numbers.json")
    assert done.exit_code == 0, done.output
    assert "recipe tiny, 1 steps, batch 1, seeds 0,4; scored on `val`" in done.output
    numbers = json.loads(Path("numbers.json").read_text())
    assert [len(row["ours"]) for row in numbers["rows"]] == [0, 2, 2]
    assert numbers["recipe"]["optim"]["batch"] == 1


@pytest.mark.parametrize("text", ["", "a", "0,0", "-1", "1,,2"])
def test_seeds_must_be_different_whole_numbers(text: str) -> None:
    with pytest.raises(BeamboxError, match="--seeds takes different whole numbers, as 0,1,2; got"):
        ablate.parse_seeds(text)
    assert ablate.parse_seeds("0, 2") == [0, 2]


def test_a_missing_recipe_or_folder_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    error = run_command("hcnet-table3", "--recipe", "hcnet_smal").exception
    assert 'no recipe is called "hcnet_smal" and no such file is there (did you mean "hcnet-small"?)' in str(error)
    error = run_command("hcnet-table3", "--data", str(tmp_path / "none")).exception
    assert str(error) == f"--data: there is no folder {tmp_path / 'none'}"


def test_a_table_of_ones_own_is_trained_as_its_page_says(
    tmp_path: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "ablations.md").read_text(encoding="utf-8")
    text = page.split("```yaml\n")[1].split("```")[0]
    Path("mine.yaml").write_text(text, encoding="utf-8")
    run_recipe = read_table(Path("mine.yaml"))
    assert [(row.name, row.options) for row in run_recipe.rows] == [
        ("without", {"absolute_xy": False}),
        ("with", {"absolute_xy": True}),
    ]
    assert read_recipe(run_recipe.recipe).detector.name == "pointpillars"
    Path("tiny.yaml").write_text(json.dumps(tiny_recipe().model_dump(mode="json")), encoding="utf-8")
    words = ["--table", "mine.yaml", "--recipe", "tiny.yaml", "--iterations", "1", "--set", "optim.batch=1"]
    done = run_command(*words)
    assert done.exit_code == 0, done.output
    assert "does it help to know where a pillar stands?" in done.output
    assert done.output.count("ours ") >= 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title: x", "recipe: Field required"),
        ("title: x\nrecipe: y\nclasses: [Car]\nrows: {}", "rows: Dictionary should have at least 1 item"),
        ("title: x\nrecipe: y\nclasses: [Car]\nrows: {a: {}}\nrow: 1", "row: Extra inputs are not permitted"),
        ("{", "is not valid YAML"),
        ("", "the file: Input should be a valid dictionary"),
    ],
)
def test_a_broken_table_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(BeamboxError, match=message):
        read_table(tmp_path / "mine.yaml")
    assert "one of the two" in str(run_command().exception)


def test_the_papers_tables_hold_what_they_print() -> None:
    def row(table: str, name: str) -> tuple[float | None, ...]:
        return next(row.published for row in table_of(table).rows if row.name == name)

    assert row("dennet-table1", "DenNet") == (90.72, 81.93, 77.48, 46.10, 40.23, 33.47, 78.89, 64.15, 56.81)
    assert row("dennet-table2", "Voxel R-CNN") == (92.86, 85.13, 82.84, 69.37, 61.56, 56.39, 91.63, 74.52, 70.25)
    assert row("dennet-table2", "PV-RCNN") == row("dennet-table1", "PV-RCNN"), "as printed, and remarked upon"
    assert row("kassd-table1", "KASSD") == (88.92, 79.75, 72.17) and len(table_of("kassd-table1").rows) == 18
    assert row("kassd-table2", "CIA-SSD") == (90.04, 79.81, 78.80) and len(table_of("kassd-table2").rows) == 22
    assert [r.published for r in table_of("kassd-table7").rows] == [(643.0,), (60.0,), (46.3,), (38.0,), (45.9,)]
    assert row("hcnet-table1", "PointPillars") == (87.50, 77.01, 74.77, 16.0)
    assert row("hcnet-table2", "HCNet")[-1] == 32.0
