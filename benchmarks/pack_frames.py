"""Pack sweeps, labels and calibrations of a data set in KITTI's layout into one small file, and unpack it again.

    python benchmarks/pack_frames.py KITTI_DIR OUT.pack --split train
    python benchmarks/pack_frames.py --unpack OUT.pack DIR

For carrying data to a machine that nothing but a few files reach. Nothing is lost: KITTI writes coordinates in
millimetres and reflectances in hundredths, so whole numbers hold them exactly; packing unpacks every frame again and
compares it with the original, byte for byte. Neighbours in a sweep lie near each other, so differences are stored,
byte by byte of their significance, compressed by LZMA: about 3 bytes a point (16 in KITTI's own files).

The file is a zip archive: sweep ID.points (two little-endian int32, points
and zeros with a minus, then the LZMA stream), training/calib/ID.txt,
training/label_2/ID.txt and ImageSets/SPLIT.txt as they are.
"""

from __future__ import annotations

import argparse
import lzma
import os
import zipfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

PLANES = 3
"""Bytes kept of a difference of two coordinates in millimetres: up to 8 km."""


def encode(points: np.ndarray) -> bytes:
    """Encode ``(N, 4)`` float32 points.

    Raises:
        SystemExit: if they are not whole millimetres and hundredths: this would lose something.
    """
    meters = points[:, :3].astype(np.float64)
    whole = np.round(meters * 1000).astype(np.int32)
    bright = np.round(points[:, 3].astype(np.float64) * 100).astype(np.int64)
    if not ((whole / 1000).astype(np.float32) == points[:, :3]).all():
        raise SystemExit("a coordinate is not a whole number of millimetres as KITTI's are; packing would change it")
    if not ((bright / 100).astype(np.float32) == points[:, 3]).all() or bright.min(initial=0) < 0:
        raise SystemExit("a reflectance is not a whole number of hundredths as KITTI's are; packing would change it")
    step = np.diff(whole, axis=0, prepend=np.zeros((1, 3), np.int32))
    zigzag = ((step << 1) ^ (step >> 31)).astype("<u4")  # small numbers of either sign have small codes
    assert int(zigzag.max(initial=0)) < 256**PLANES
    planes = zigzag.T.copy().view(np.uint8).reshape(3, len(points), 4).transpose(0, 2, 1)[:, :PLANES]  # (3, PLANES, N)
    minus = np.flatnonzero(np.signbit(points) & (points == 0)).astype("<u4")  # -0.0, which a whole number cannot tell
    stream = planes.tobytes() + bright.astype(np.uint8).tobytes() + minus.tobytes()
    return b"".join(n.to_bytes(4, "little") for n in (len(points), len(minus))) + lzma.compress(stream, preset=6)


def decode(data: bytes) -> np.ndarray:
    """Return the ``(N, 4)`` float32 points that :func:`encode` was given."""
    count, minus = (int.from_bytes(data[at : at + 4], "little") for at in (0, 4))
    size = count * (3 * PLANES + 1) + 4 * minus
    stream = lzma.LZMADecompressor().decompress(data[8:], max_length=size + 1)
    if len(stream) != size:
        raise SystemExit(f"a sweep of {count} points needs {size} bytes, its stream holds {len(stream)}")
    planes = np.zeros((3, 4, count), np.uint8)
    planes[:, :PLANES] = np.frombuffer(stream, np.uint8, 3 * PLANES * count).reshape(3, PLANES, count)
    zigzag = planes.transpose(0, 2, 1).copy().view("<u4")[..., 0].astype(np.int64)  # (3, N)
    whole = np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1)
    points = np.empty((count, 4), "<f4")
    points[:, :3] = (whole.T / 1000).astype(np.float32)
    points[:, 3] = (np.frombuffer(stream, np.uint8, count, 3 * PLANES * count) / 100).astype(np.float32)
    points.reshape(-1)[np.frombuffer(stream, "<u4", minus, size - 4 * minus)] = -0.0
    return points


def packed(path: Path) -> bytes:
    """Encode one sweep's file and make sure that nothing is lost."""
    raw = path.read_bytes()
    data = encode(np.frombuffer(raw, "<f4").reshape(-1, 4))
    if decode(data).tobytes() != raw:
        raise SystemExit(f"{path} does not come back as it was")
    return data


def pack(root: Path, out: Path, splits: list[str]) -> None:
    """Write the frames of some splits into one file."""
    lists = {split: (root / "ImageSets" / f"{split}.txt").read_text().split() for split in splits}
    names = sorted({name for listed in lists.values() for name in listed})
    sweeps = [root / "training" / "velodyne" / f"{name}.bin" for name in names]
    draft = out.with_suffix(".part")
    with zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as archive, ProcessPoolExecutor() as pool:
        for split, listed in lists.items():
            archive.writestr(f"ImageSets/{split}.txt", "".join(f"{name}\n" for name in listed))
        for name, data in zip(names, pool.map(packed, sweeps, chunksize=4)):
            archive.writestr(zipfile.ZipInfo(f"{name}.points"), data)
            for kind in ("calib", "label_2"):
                archive.write(root / "training" / kind / f"{name}.txt", f"training/{kind}/{name}.txt")
    draft.replace(out)
    before = sum(path.stat().st_size for path in sweeps)
    print(f"{len(names)} frames, {before / 1e6:.1f} MB of points: {out.stat().st_size / 1e6:.1f} MB, each compared")


def unpack(file: Path, folder: Path) -> list[str]:
    """Write what a packed file holds in KITTI's layout; returns the names of the splits."""
    with zipfile.ZipFile(file) as archive:
        entries = [entry for entry in archive.infolist() if not entry.is_dir()]
        for entry in entries:
            target = folder / entry.filename
            if not target.resolve().is_relative_to(folder.resolve()):
                raise SystemExit(f"{file} names a place outside the folder: {entry.filename}")
            if not entry.filename.endswith(".points"):
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(archive.read(entry))
        (folder / "training" / "velodyne").mkdir(parents=True, exist_ok=True)
        names = [entry.filename.removesuffix(".points") for entry in entries if entry.filename.endswith(".points")]
        with ProcessPoolExecutor(min(16, os.cpu_count() or 1)) as pool:
            list(pool.map(_unpack_sweep, [file] * len(names), names, [folder] * len(names), chunksize=8))
    return sorted(Path(e.filename).stem for e in entries if e.filename.startswith("ImageSets/"))


def _unpack_sweep(file: Path, name: str, folder: Path) -> None:
    with zipfile.ZipFile(file) as archive:
        points = decode(archive.read(f"{name}.points"))
    (folder / "training" / "velodyne" / f"{name}.bin").write_bytes(points.tobytes())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument(
        "--split", nargs="+", default=["train"], help="lists in ImageSets/; pack no split that is for testing"
    )
    parser.add_argument("--unpack", action="store_true")
    arguments = parser.parse_args()
    if arguments.unpack:
        print("unpacked: " + ", ".join(unpack(arguments.source, arguments.target)))
    else:
        pack(arguments.source, arguments.target, arguments.split)


if __name__ == "__main__":
    main()
