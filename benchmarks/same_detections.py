"""Whether detection that leaves out empty ground finds on real sweeps what PyTorch's convolutions find.

    python benchmarks/same_detections.py [KITTI] [--models pointpillars-kitti ...] [--every 1]

Every sweep passes through two detectors of the same weights, float32; one computes all cells by PyTorch's convolutions
of maps. Prints the largest differences of boxes (metres, radians) and scores, and each sweep beyond 1e-3 or 1e-4.
"""

from __future__ import annotations

import argparse
import math
import os
from pathlib import Path

import torch
from sides import ROOT

BOX, SCORE = 1e-3, 1e-4


def differences(model: str, data: Path, every: int) -> str:
    """Compare on every sweep and return a line of what was found."""
    from beambox import load
    from beambox.data.kitti import KittiSource
    from beambox.ops import map_conv

    source = KittiSource(data, "all", fov=True)
    ours, plain = (load(model, device="cpu", precision="float32") for _ in range(2))
    choice = map_conv.why_plain
    boxes, scores, found, apart, sweeps = 0.0, 0.0, 0, 0, range(0, len(source), every)
    for k in sweeps:
        frame = source[k]
        a = ours.detect([frame])[0]
        map_conv.why_plain = lambda *_: "it is the other side"
        b = plain.detect([frame])[0]
        map_conv.why_plain = choice
        found += len(b)
        if len(a) != len(b):
            apart += 1
            print(f"{model}, {frame.id}: {len(a)} and {len(b)} detections")
        elif len(a):
            gap = a.boxes - b.boxes
            gap[:, 6] = torch.remainder(gap[:, 6] + math.pi, 2 * math.pi) - math.pi
            box, score = float(gap.abs().max()), float((a.scores - b.scores).abs().max())
            if box > BOX or score > SCORE:
                apart += 1
                print(f"{model}, {frame.id}: boxes differ by {box:.1e}, scores by {score:.1e}")
            boxes, scores = max(boxes, box), max(scores, score)
    return (
        f"{model}: {len(sweeps)} sweeps, {found} detections, {apart} sweeps beyond {BOX:.0e} or {SCORE:.0e}; "
        f"largest differences: boxes {boxes:.1e}, scores {scores:.1e}"
    )


def main() -> None:
    data = Path(os.environ.get("BEAMBOX_DATA", ROOT / ".." / "shared" / "data"))
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("data", type=Path, nargs="?", default=data / "kitti", help="a data set in KITTI's layout")
    parser.add_argument("--models", nargs="+", default=["pointpillars-kitti", "voxel_rcnn-kitti", "kassd-kitti"])
    parser.add_argument("--every", type=int, default=1, help="take each so manieth sweep")
    arguments = parser.parse_args()
    for model in arguments.models:
        print(differences(model, arguments.data, arguments.every), flush=True)


if __name__ == "__main__":
    main()
