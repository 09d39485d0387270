"""`beambox data check|anchors|voxels|splits|convert`: look at a data set before training on it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beambox.cli.main import guard, help_of
from beambox.cli.options import expect_there

__all__ = ["app"]

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Look at a data set: say what seems wrong, propose anchors, count points; write lists, convert labels.",
)

DATA = Annotated[Path, typer.Argument(metavar="DATA", help="YAML file of a data set, or a KITTI or ONCE folder.")]
SPLIT = Annotated[str, typer.Option(help="List of frames; all is every frame.")]
FRAMES = Annotated[int | None, typer.Option(min=1, help="Look at this many frames, spread evenly; default: all.")]


def check(
    data: DATA,
    split: SPLIT = "all",
    frames: FRAMES = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Also write the report to this file.")] = None,
) -> None:
    """Read everything and report what looks wrong; status 2 if a frame cannot be read.

    Examples:
      beambox data check data.yaml
      beambox data check kitti --split train --frames 200
    """
    expect_there([data])
    import json

    from beambox.checks import BeamboxError
    from beambox.cli.console import progress
    from beambox.data.checking import check_frames
    from beambox.data.custom import CustomSource
    from beambox.data.custom_config import KITTI_GROUND
    from beambox.data.format_report import format_report, report_json
    from beambox.data.open_dataset import open_dataset
    from beambox.io import write_text

    source = open_dataset(data, split)
    limits, ground = None, None
    if isinstance(source, CustomSource):
        source = CustomSource(data, split, whole=True)
        limits = source.config.range
        ground = None if source.config.sensor_height is None else KITTI_GROUND
    chosen = spread(len(source), frames)
    report = check_frames(source, progress(chosen, len(chosen), "reading"), limits)
    print(format_report(report, ground), end="")
    if json_file is not None:
        write_text(json_file, json.dumps(report_json(report, ground), indent=1, allow_nan=False) + "\n")
    if report.unreadable:
        raise BeamboxError(f"{len(report.unreadable)} of {report.frames} frames cannot be read")


def anchors(data: DATA, split: SPLIT = "all", frames: FRAMES = None) -> None:
    """Propose anchor sizes and heights from the labels, as lines for a recipe.

    Examples:
      beambox data anchors data.yaml --split train
    """
    expect_there([data])
    from beambox.checks import BeamboxError
    from beambox.cli.console import progress
    from beambox.data.anchor_sizes import proposals_text, propose_anchors
    from beambox.data.open_dataset import open_dataset

    source = open_dataset(data, split)
    chosen = spread(len(source), frames)
    labels = (source[index].labels for index in progress(chosen, len(chosen), "reading"))
    proposals = propose_anchors(one for one in labels if one is not None)
    if not proposals:
        raise BeamboxError(f"{data} has no labelled box in the split {split}, so there is nothing to propose")
    print(proposals_text(proposals), end="")


def voxels(
    data: DATA,
    split: SPLIT = "all",
    frames: FRAMES = None,
    cell: Annotated[str, typer.Option(metavar="X,Y,Z", help="Edge lengths of a voxel in metres.")] = "0.1,0.1,0.15",
    out: Annotated[Path | None, typer.Option(help="Draw the histogram into this picture.")] = None,
) -> None:
    """Tell how many points a voxel holds: DenNet's figure 2 for any data set.

    Examples:
      beambox data voxels once --split val --frames 100 --cell 0.1,0.1,0.2 --out figure2.png
    """
    expect_there([data])
    from beambox.checks import BeamboxError
    from beambox.cli.console import progress
    from beambox.data.open_dataset import open_dataset
    from beambox.visualize.canvas import save_picture
    from beambox.visualize.voxel_histogram import draw_histogram, voxel_histogram

    try:
        x, y, z = (float(word) for word in cell.split(","))
    except ValueError:
        raise BeamboxError(f'--cell takes three lengths in metres, as 0.1,0.1,0.15; got "{cell}"') from None
    source = open_dataset(data, split)
    chosen = spread(len(source), frames)
    sweeps = (source[index] for index in progress(chosen, len(chosen), "reading"))
    histogram = voxel_histogram(sweeps, (x, y, z))
    print(histogram.table(), end="")
    if out is not None:
        save_picture(draw_histogram(histogram, f"{data.name} {split}"), out)


def splits(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="KITTI's folder, which holds training/velodyne.")],
    partial: Annotated[bool, typer.Option("--partial", help="List only the frames that are there.")] = False,
) -> None:
    """Write KITTI's usual lists into DIR/ImageSets: train (3712 frames), val (3769), trainval and test.

    Examples:
      beambox data splits kitti
    """
    expect_there([folder])
    from beambox.data.kitti_splits import write_kitti_splits

    for name, count in write_kitti_splits(folder, partial=partial).items():
        print(f"{folder / 'ImageSets' / name}.txt: {count} frames")


def convert(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Label file, or folder of label files.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File or folder to write.")],
    kind: Annotated[str, typer.Option("--from", metavar="F", help="Format of the source.")],
    wanted: Annotated[str, typer.Option("--to", metavar="F", help="Format to write.")],
    calib: Annotated[Path | None, typer.Option(help="For KITTI: calib file, or folder of FRAME.txt.")] = None,
    degrees: Annotated[
        bool | None, typer.Option("--degrees/--radians", help="Angles of the source, where not as usual.")
    ] = None,
) -> None:
    """Turn labels of one annotation tool into those of another.

    Examples:
      beambox data convert labels --from labelcloud --to openpcdet --out custom/labels
      beambox data convert export.json --from datumaro --to kitti --calib calib --out label_2
      beambox data convert detections --from json --to sustechpoints --out scene/label

    Formats: openpcdet, mmdet3d, sustechpoints, labelcloud (degrees), labelcloud_rel (radians), labelcloud_vertices,
    supervisely, datumaro (CVAT), segments, scale, openlabel, pandaset_columns, table (CSV with any usual names), kitti;
    read only: pandaset, once, csv, json (as `beambox detect` writes them).
    """
    expect_there([source, calib])
    from beambox.cli.console import log
    from beambox.data.labels.convert import convert_labels

    frames, notes = convert_labels(source, kind, out, wanted, calib=calib, degrees=degrees)
    for note in notes:
        log(f"note: {note}")
    print(f"{sum(map(len, frames.values()))} boxes of {len(frames)} frames -> {out}")


def spread(total: int, wanted: int | None) -> list[int]:
    """Return the positions of ``wanted`` frames, spread evenly over all; all of them where None."""
    if wanted is None or wanted >= total:
        return list(range(total))
    return [round(k * (total - 1) / max(1, wanted - 1)) for k in range(wanted)]


for function in (check, anchors, voxels, splits, convert):
    app.command(help=help_of(function))(guard(function))
