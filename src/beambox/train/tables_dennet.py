"""DenNet's tables (Qian et al., Photonics 9:820, 2022)."""

from __future__ import annotations

from beambox.train.table import TIME, Column, Row, Table, levels

__all__ = ["DENNET"]

THREE_CLASSES = (*levels("Car", "3d", "R40"), *levels("Pedestrian", "3d", "R40"), *levels("Cyclist", "3d", "R40"))
BASELINE = {"vda": False, "na": False, "ca": False}

DENNET: dict[str, Table] = {
    "dennet-table1": Table(
        title="DenNet, table 1: 3-D detection, three classes",
        protocol="KITTI test server, R40; IoU 0.7 printed for all; the server takes 0.5 for pedestrian and cyclist",
        recipe="dennet-kitti-3class",
        columns=THREE_CLASSES,
        rows=(
            Row("SECOND", (84.65, 75.96, 68.71, 45.31, 35.52, 33.14, 75.83, 60.82, 53.67)),
            Row("PV-RCNN", (90.25, 81.43, 76.82, 52.17, 43.29, 40.29, 78.6, 63.71, 57.65)),
            Row("PointPillars", (82.58, 74.31, 68.99, 51.45, 41.92, 38.89, 77.1, 58.65, 51.92)),
            Row("PointRCNN", (86.96, 75.64, 70.7, 47.98, 39.37, 36.01, 74.96, 58.82, 52.53)),
            Row("PointGNN", (88.33, 79.47, 72.29, 51.92, 43.77, 40.14, 78.6, 63.48, 57.08)),
            Row("Part-A^2", (87.81, 78.49, 73.51, 53.1, 43.35, 40.06, 79.17, 63.52, 56.93)),
            Row("TANet", (84.39, 75.94, 68.82, 53.72, 44.34, 40.49, 75.7, 59.44, 52.53)),
            Row("3DSSD", (88.36, 79.57, 74.55, None, None, None, None, None, None)),
            Row("SASA", (88.76, 82.16, 77.16, None, None, None, None, None, None)),
            Row("Voxel R-CNN", (90.9, 81.62, 77.06, None, None, None, None, None, None)),
            Row("PDV", (90.43, 81.86, 77.36, None, None, None, 83.04, 67.81, 60.46)),
            Row("DenNet", (90.72, 81.93, 77.48, 46.1, 40.23, 33.47, 78.89, 64.15, 56.81), {}),
        ),
        remarks=("the test server's labels are not public: ours is of the validation split",),
    ),
    "dennet-table2": Table(
        title="DenNet, table 2: 3-D detection, three classes",
        protocol="KITTI validation split, R40, IoU 0.7, 0.5, 0.5",
        recipe="dennet-kitti-3class",
        columns=THREE_CLASSES,
        rows=(
            Row("PV-RCNN", (90.25, 81.43, 76.82, 52.17, 43.29, 40.29, 78.6, 63.71, 57.65)),
            Row("3DSSD", (91.04, 82.32, 79.81, 59.14, 55.19, 50.86, 88.05, 69.84, 65.41)),
            Row("IA-SSD", (91.88, 83.41, 80.44, 61.22, 56.77, 51.15, 88.42, 70.14, 65.99)),
            Row("CT3D", (92.34, 84.97, 82.91, 61.05, 56.67, 51.1, 89.01, 71.88, 67.91)),
            Row("PDV", (92.56, 85.29, 83.05, 66.9, 60.8, 55.85, 92.72, 74.23, 69.6)),
            Row("SASA", (91.82, 84.48, 82.0, 62.32, 58.02, 53.3, 89.11, 72.61, 68.19)),
            Row("Voxel R-CNN", (92.86, 85.13, 82.84, 69.37, 61.56, 56.39, 91.63, 74.52, 70.25), BASELINE),
            Row("DenNet", (92.62, 85.39, 82.83, 66.26, 59.52, 54.15, 93.22, 75.27, 70.59), {}),
        ),
        remarks=(
            "PV-RCNN's row is that of table 1, of the test server",
            "Voxel R-CNN's row fits voxels of 0.05 m; ours has the recipe's 0.1 m",
        ),
    ),
    "dennet-table4": Table(
        title="DenNet, table 4: its three modules",
        protocol="ONCE validation split, AP over all distances; device and protocol of the times are not stated",
        recipe="dennet-once",
        columns=(
            *(Column(f"ONCE {name}", "overall", (name, "overall")) for name in ("Vehicle", "Pedestrian", "Cyclist")),
            Column("ONCE mAP", "overall", ("mean", "overall")),
            TIME,
        ),
        rows=(
            Row("Voxel R-CNN", (73.53, 35.66, 59.85, 56.35, 27.72), BASELINE),
            Row("VDA", (78.82, 28.94, 61.24, 55.89, 32.99), {"na": False, "ca": False}),
            Row("VDA + NA", (79.94, 32.28, 64.35, 58.86, 34.68), {"ca": False}),
            Row("VDA + NA + CA", (80.24, 35.68, 65.59, 60.31, 35.56), {}),
        ),
        remarks=(
            "mAP as printed; the means of the printed classes are 56.35, 56.33, 58.86 and 60.50",
            "ours: time is the median of one sweep at a time, from points to boxes, without reading files",
        ),
    ),
}
"""By the name that `beambox ablate` takes."""
