"""`beambox score kitti|once|tracking`: score result files without running a detector."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from beambox.cli.main import guard, help_of
from beambox.cli.options import IouOption, expect_there, parse_classes

__all__ = ["app", "parse_overlaps"]

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Score result files with the official rules of a benchmark.",
)

Json = Annotated[Path | None, typer.Option("--json", help="also write the numbers to this file")]


def parse_overlaps(text: str) -> dict[str, float]:
    """Read overlaps written as ``Car=0.5,Pedestrian=0.25``, one per class."""
    from beambox.infer.evaluate import parse_overlaps as parse

    return parse([text])


def conclude(results: Sequence[Any], tables: Sequence[str], path: Path | None) -> None:
    """Print the tables, and write the numbers for other programs."""
    print("\n".join(tables), end="")
    if path is not None:
        from beambox.io import write_json
        from beambox.metrics.rounds import merge_entries

        write_json(path, merge_entries(results))


def kitti(
    labels: Annotated[Path, typer.Option(help="folder of label files (or the KITTI root above label_2)")],
    results: Annotated[Path, typer.Option(help="folder of result files, one per frame; empty: nothing found")],
    frame_list: Annotated[
        Path | None, typer.Option("--frame-list", help="file with one frame name per line; default: every label")
    ] = None,
    classes: Annotated[str, typer.Option(help="classes to score, as Car,Cyclist")] = "Car,Pedestrian,Cyclist",
    iou: IouOption = None,
    no_difficulty: Annotated[
        bool, typer.Option("--no-difficulty", help="every object counts; 3d and bev only")
    ] = False,
    python_port: Annotated[bool, typer.Option("--python-port", help="follow the Python port where it differs")] = False,
    allow_missing: Annotated[bool, typer.Option("--allow-missing", help="no result file means nothing found")] = False,
    json: Json = None,
    frames: Annotated[Path | None, typer.Option(help="the former name of --frame-list", hidden=True)] = None,
) -> None:
    """Score KITTI result files as the official program does (needs no images, points or calibration).

    Examples:
      beambox score kitti --labels kitti/training/label_2 --results out --frame-list kitti/ImageSets/val.txt
      beambox score kitti --labels kitti --results out --classes Car --iou Car=0.5 --json ap.json
    """
    listed = frame_list or frames
    expect_there([labels, results, listed])

    from beambox.metrics.kitti import evaluate_files
    from beambox.metrics.kitti_objects import read_frame_list
    from beambox.metrics.rounds import parse_rounds, score_rounds

    names = None if listed is None else read_frame_list(listed)
    results_of_rounds = score_rounds(
        lambda wanted, overlaps: evaluate_files(
            labels,
            results,
            names,
            wanted,
            min_overlap=overlaps,
            no_difficulty=no_difficulty,
            python_port=python_port,
            allow_missing=allow_missing,
        ),
        parse_classes(classes),
        parse_rounds(iou or []),
    )
    conclude(results_of_rounds, [result.table() for result in results_of_rounds], json)


def once(
    annotations: Annotated[Path, typer.Option(help="JSON with ground_truth, and with predictions unless --results")],
    results: Annotated[Path | None, typer.Option(help="JSON list of predictions in a file of its own")] = None,
    classes: Annotated[str, typer.Option(help="classes to score, as Vehicle,Cyclist; default: all")] = "",
    five_classes: Annotated[bool, typer.Option("--five-classes", help="do not merge Car, Bus, Truck")] = False,
    iou: IouOption = None,
    true_rotation: Annotated[bool, typer.Option("--true-rotation", help="turn boxes the right way round")] = False,
    published: Annotated[bool, typer.Option("--published", help="also print the rows of DenNet's Table 3")] = False,
    json: Json = None,
) -> None:
    """Score ONCE predictions as the official devkit does.

    Examples:
      beambox score once --annotations annotations.json
      beambox score once --annotations val.json --results predictions.json --published --json ap.json
    """
    expect_there([annotations, results])

    from beambox.metrics.once import evaluate_annotations
    from beambox.metrics.rounds import parse_rounds, score_rounds

    scored = score_rounds(
        lambda wanted, overlaps: evaluate_annotations(
            annotations,
            results,
            five_classes=five_classes,
            min_overlap=overlaps,
            true_rotation=true_rotation,
            known=wanted or None,
        ),
        parse_classes(classes),
        parse_rounds(iou or []),
    )
    conclude(scored, [result.table(published=published) for result in scored], json)


def tracking(
    labels: Annotated[Path, typer.Option(help="label file of a drive, or folder of label files, one per drive")],
    results: Annotated[Path, typer.Option(help="tracks of the drive, or folder of files with the labels' names")],
    calib: Annotated[Path, typer.Option(help="calib file, or folder of files with the labels' names")],
    classes: Annotated[str, typer.Option(help="classes to score, comma-separated")] = "Car,Pedestrian,Cyclist",
    overlap: Annotated[str, typer.Option(help="3d, bev, or 2d as KITTI's benchmark")] = "3d",
    iou: IouOption = None,
    json: Json = None,
) -> None:
    """Score tracks in KITTI's format: HOTA, MOTA, AMOTA, identity switches.

    Examples:
      beambox score tracking --labels label_02/0012.txt --results tracks.txt --calib calib/0012.txt
      beambox score tracking --labels label_02 --results out --calib calib --classes Car --overlap 2d
    """
    expect_there([labels, results, calib])

    from beambox.track.scoring import read_drives, score_tracks

    result = score_tracks(
        read_drives(labels, results, calib),
        parse_classes(classes),
        overlap=overlap,  # pyright: ignore[reportArgumentType]  # score_tracks checks it
        min_overlap=parse_overlaps(",".join(iou)) if iou else None,
    )
    print(result.table(), end="")
    if json is not None:
        from beambox.io import write_json

        write_json(json, result.to_json())


for function in (kitti, once, tracking):
    app.command(help=help_of(function))(guard(function))
