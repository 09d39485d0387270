"""Score the tracker beside a simple one, frame-to-frame greedy overlap, on a drive of KITTI's tracking benchmark.

    python benchmarks/tracking.py --results DIR --labels label_02.txt --calib calib.txt

DIR holds the detections of the drive, one file per sweep, as `beambox detect --format json` writes them. The simple
tracker continues an identity where the boxes of two successive sweeps overlap by more than 0.1 in BEV, best
overlap first; it takes detections from score 0.3 or, tried as well, 0.5 on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from beambox.data.kitti_text import read_calibration
from beambox.data.kitti_tracking import format_tracking, parse_tracking, read_tracking
from beambox.geometry import Calibration
from beambox.ops.rotated_iou import iou_bev
from beambox.structures import Detections
from beambox.track import Tracker
from beambox.track.scoring import score_tracks
from beambox.track.sequence import Step, read_drive, track_drive

IMAGE = (1242, 375)


def simple(steps: list[Step], calibration: Calibration, score_threshold: float) -> str:
    """Track by overlap with the sweep before, nothing else."""
    text, following = "", 1
    before, known = Detections.empty(), []
    for step in steps:
        found = step.detections[step.detections.scores >= score_threshold]
        ids = [0] * len(found)
        if len(before) and len(found):
            overlap = iou_bev(found.boxes, before.boxes)
            overlap *= torch.tensor([[a == b for b in before.names] for a in found.names])
            while float(overlap.max()) > 0.1:
                new, old = divmod(int(overlap.argmax()), overlap.shape[1])
                ids[new] = known[old]
                overlap[new], overlap[:, old] = 0, 0
        for k, number in enumerate(ids):
            if not number:
                ids[k], following = following, following + 1
        before, known = found, ids
        rows = (ids, found.names, found.boxes, found.scores.tolist(), calibration, IMAGE)
        text += format_tracking(step.number, *rows)
    return text


def ours(steps: list[Step], calibration: Calibration) -> str:
    """Track with the defaults."""
    text = ""
    for step, tracks in track_drive(Tracker(), steps):
        found = tracks.detections
        rows = (tracks.ids.tolist(), tracks.names, found.boxes, found.scores.tolist(), calibration, IMAGE)
        text += format_tracking(step.number, *rows)
    return text


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("results", "labels", "calib"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--classes", default="Car")
    given = parser.parse_args()
    calibration = read_calibration(given.calib)
    labels, steps = read_tracking(given.labels, calibration), read_drive(given.results, calibration)
    texts = {"beambox track": ours(steps, calibration)}
    texts |= {f"overlap, from {least}": simple(steps, calibration, least) for least in (0.3, 0.5)}
    for name, text in texts.items():
        result = score_tracks([(labels, parse_tracking(text, calibration))], given.classes.split(","))
        print(f"{name}\n{result.table()}")


if __name__ == "__main__":
    main()
