"""HCNet's tables (Zhang et al., Remote Sensing 13:5071, 2021); its figures 10 to 12 draw them again."""

from __future__ import annotations

from beambox.train.table import CAR_3D_R11, TIME, Row, Table, levels

__all__ = ["HCNET"]

HCNET_VAL = "KITTI validation split, cars, IoU 0.7; R11 is not stated, but the baselines it copies are R11"

HCNET: dict[str, Table] = {
    "hcnet-table1": Table(
        title="HCNet, table 1: 3-D detection on the validation split",
        protocol=HCNET_VAL,
        recipe="hcnet-kitti-car",
        columns=(*CAR_3D_R11, TIME),
        rows=(
            Row("VoxelNet", (81.97, 65.46, 62.85, 230.0)),
            Row("SECOND", (85.50, 75.04, 68.78, 50.0)),
            Row("PointPillars", (87.50, 77.01, 74.77, 16.0)),
            Row("PointRCNN", (88.26, 77.73, 76.67, 100.0)),
            Row("HCNet", (88.45, 78.01, 76.72, 32.0), {}),
        ),
        remarks=(
            "figure 10 draws this table",
            "HCNet's time is of an RTX 2080 Ti; the GPU of the others is not stated",
        ),
    ),
    "hcnet-table2": Table(
        title="HCNet, table 2: from above, in 3-D, and orientation",
        protocol="KITTI test server, cars, IoU 0.7; HCNet's own row (late 2021) is R40, the others are older, R11",
        recipe="hcnet-kitti-car",
        columns=(*levels("Car", "bev", "R40"), *levels("Car", "3d", "R40"), *levels("Car", "aos", "R40"), TIME),
        rows=(
            Row("VoxelNet", (89.35, 79.26, 77.39, 77.47, 65.11, 57.73, None, None, None, 230.0)),
            Row("SECOND", (88.07, 79.37, 77.95, 83.13, 73.66, 66.20, 87.84, 81.31, 71.85, 50.0)),
            Row("PointPillars", (88.35, 86.10, 79.83, 79.05, 74.99, 68.30, 90.19, 88.76, 86.38, 16.0)),
            Row("PointRCNN", (89.28, 86.04, 79.02, 84.32, 75.42, 67.86, 90.76, 89.55, 80.76, 100.0)),
            Row("SARPNET", (88.93, 87.26, 78.68, 84.92, 75.64, 67.70, 90.16, 88.86, 80.05, 50.0)),
            Row("HCNet", (90.27, 86.91, 81.90, 81.31, 73.56, 68.42, 95.05, 91.44, 88.02, 32.0), {}),
        ),
        remarks=("figure 11 draws its AOS", "AOS is bounded by the AP in the image, not by the one from above"),
    ),
    "hcnet-table3": Table(
        title="HCNet, table 3: which attention weighs the pseudo images",
        protocol=HCNET_VAL,
        recipe="hcnet-kitti-car",
        columns=CAR_3D_R11,
        rows=(
            Row("none", (None, None, None), {"attention": "none"}),
            Row("CA", (87.22, 77.33, 75.78), {"attention": "CA"}),
            Row("HA", (87.19, 77.26, 75.82), {"attention": "HA"}),
            Row("HCA", (88.45, 78.01, 76.72), {}),
        ),
        remarks=("figure 12 draws this table", "`none`, a plain maximum over the slices, is not in the paper"),
    ),
    "hcnet-table4": Table(
        title="HCNet, table 4: parts of the head",
        protocol=HCNET_VAL,
        recipe="hcnet-kitti-car",
        columns=CAR_3D_R11,
        rows=(
            Row("neither", (None, None, None), {"oifm": False, "aam": False}),
            Row("AAM", (87.23, 77.33, 75.70), {"oifm": False}),
            Row("OIFM", (88.32, 78.08, 76.52), {"aam": False}),
            Row("AAM + OIFM", (88.45, 78.01, 76.72), {}),
        ),
        remarks=("`neither` is not in the paper",),
    ),
}
"""By the name that `beambox ablate` takes."""
