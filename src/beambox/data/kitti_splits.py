"""KITTI's 7481 training frames, parted into the 3712 and 3769 on which results are published.

The split is the one of Chen et al., "3D Object Proposals for Accurate Object Class Detection" (NeurIPS 2015), which
every publication since has used: whole drives go to one side or the other. A set bit is a frame of train, the others
are val; the lowest bit of the first byte is frame 000000.
"""

from __future__ import annotations

import base64
from pathlib import Path

from beambox.checks import BeamboxError, MissingFileError
from beambox.file_names import read_names
from beambox.io import write_text

__all__ = ["kitti_splits", "write_kitti_splits"]

TRAINING_FRAMES = 7481
TEST_FRAMES = 7518
_TRAIN = (
    "iX5HZFV6yhP5j/2Zu+KPqy5ld2x9GB8jQmXHehpDO+AviTzl0Z1FcmRMTjFCmMkQaQBhHKeHz7YCdc8EnAVyilZt2h5pMyzkXw/37APj"
    "qGNLeuGXW+OnouqPWbTMKeodhLO/tgDhdnufZKg33wHNnfVWxrLiI86sJZFWaH87ApPxV7MTewGHpzyUYqFWBUKEsHPPIEcwN5+YqEKB"
    "BUUB8C0lfuCb/4G0sGTXL4xCl39j1nYWkfJbW59cfJ1nyQleuNHWSp00AcqSW9RV8Va7qrD34p2VEBg5zY8ZtsumCvPTaJ4pbPeuBhLH"
    "lgzK6dx/BoQM+Xo+7SFYR+iClcWDg6i4byEZlQ9ntGRyoH88lNg15e04feLMeJcyqftOIgNjonNeqcjgTRvpKnAczzcjzHi6Own/Cbdq"
    "JVhvnKBD647DKE24O6BP1ymljNdc29GcC7YT1Ah4rcCURE9/08mMIesjbQzeWvMH1AEObUvPOr1kFaC3sGxRBPO3FLAzCppx6Xq6FpOq"
    "LxWcqG1ZKwW3WmOzlEhseiP12eb0boqoJMPzWTOUD1r3+UEB4JWJ8nfY3hC7YGA8eldscHe2GPOWL+7/TLQKFvBXTZNHD+PgP2Umt37w"
    "I+XjdZHnuUqkr6PTfa/mmjiUo5HV46aneamvyWmN+q5g8N7jqNh0V+xaUWXKBA2I4CiPgOAG/wXnGxkP6l6xMGY/l8gQQ1E6JXkojfxi"
    "mH1sjCE/A5gRZquqnfIQkZ5vTTygj0fNO5iaRS/3YKuaqG5g6cF8EgThCYGIKyHobKPYPCdeLhOcHXa34ANm8V1GOtSbLCQbwimyv1aJ"
    "Ieka1eqK3Ak4pBC4G1+N/EheQtSFISqGDBu9n5GTyah1rmdhau3wRiTRGBiVf5Zk0Rn/z18/E9tFyMNxSCk9+z3z16aqeAaew4yC5/Db"
    "cD0x8smizsxWfWPC2E90RnDb0v89sOkU54PTe/Qv9N4tUY1HEQgRV/PGttFpm+hL0Yh+AikBqgkjkxdeKLODEdv2aupV3Lyxo+tat8e8"
    "Lvl7kaA6/o35wumHI0zBruDFaeEXcWzwQYiHv4yQodZ44ULMAa1PpdS4GKvE44d7yIh1ceKSC5sPWh9wloXZdCBIwglZiiZGss/MZQkq"
    "q2hJdUGj2dv6OKxh6taJl1qWIjYDmHNMVkUqQHRrn1baQ/LYm4GsKPc7SCrVlbQqT4pxEGagJx43E/E0FHzuNQxch1FBBrpBWtg6gpUA"
)


def kitti_splits() -> dict[str, list[str]]:
    """Return the usual lists by name: train (3712 frames), val (3769), trainval (7481) and test (7518)."""
    bits = base64.b64decode(_TRAIN)
    in_train = [bool(bits[number // 8] >> number % 8 & 1) for number in range(TRAINING_FRAMES)]
    names = [f"{number:06d}" for number in range(TEST_FRAMES)]
    return {
        "train": [name for name, train in zip(names, in_train) if train],
        "val": [name for name, train in zip(names, in_train) if not train],
        "trainval": names[:TRAINING_FRAMES],
        "test": names,
    }


def write_kitti_splits(root: Path | str, *, partial: bool = False) -> dict[str, int]:
    """Write ROOT/ImageSets/ with the usual lists.

    Args:
        root: the folder that holds training/velodyne (and testing/velodyne).
        partial: accept a part of KITTI, and list only the frames that are there.

    Returns:
        How many frames each list has; lists without a frame are not written.

    Raises:
        MissingFileError: if there is no training/velodyne.
        BeamboxError: if the frames are not KITTI's, or a list that is there says otherwise.
    """
    root = Path(root)
    folder = root / "training" / "velodyne"
    if not folder.is_dir():
        raise MissingFileError(f"{folder} is not a folder; expected KITTI's layout with training/velodyne/000000.bin")
    there = {path.stem for path in folder.glob("*.bin")}
    test = {path.stem for path in (root / "testing" / "velodyne").glob("*.bin")}
    usual = kitti_splits()
    strange = sorted(there - set(usual["trainval"]))
    if strange:
        raise BeamboxError(
            f"{folder} holds {strange[0]}.bin, which is none of KITTI's frames 000000 to 007480; the usual lists say "
            "nothing of other data: write ImageSets/train.txt and val.txt yourself, whole drives on one side"
        )
    if len(there) < TRAINING_FRAMES and not partial:
        raise BeamboxError(
            f"{folder} holds {len(there)} of KITTI's {TRAINING_FRAMES} training frames; --partial lists those that are "
            "there. Of data that are not KITTI's, write ImageSets/train.txt and val.txt yourself"
        )
    lists = {
        name: [one for one in names if one in (test if name == "test" else there)] for name, names in usual.items()
    }
    lists = {name: names for name, names in lists.items() if names}
    for name, names in lists.items():
        path = root / "ImageSets" / f"{name}.txt"
        if path.exists() and read_names(path) != names:
            raise BeamboxError(f"{path} is there already and names other frames; move it away first")
    for name, names in lists.items():
        write_text(root / "ImageSets" / f"{name}.txt", "".join(f"{one}\n" for one in names))
    return {name: len(names) for name, names in lists.items()}
