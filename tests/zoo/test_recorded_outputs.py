"""The shipped weights compute what they computed when their outputs were recorded, whatever became of the code since.

``tests/fixtures/shipped_outputs.npz`` holds one simulated sweep (5 mm steps, 1/255 of intensity) and the detections of
each shipped weight file on it, in float32 on a CPU. ``python tests/zoo/test_recorded_outputs.py`` records them anew;
do so only when a change of outputs is wanted.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

import beambox
from beambox.structures import Frame
from beambox.zoo import shipped

RECORDED = Path(__file__).resolve().parents[1] / "fixtures" / "shipped_outputs.npz"
STEP = 0.005
"""Metres."""
BEST = 40
"""Detections recorded of each."""


def frame_of(recorded: dict[str, np.ndarray]) -> Frame:
    """Return the sweep."""
    xyz = torch.from_numpy(recorded["xyz"].astype(np.float32)) * STEP
    intensity = torch.from_numpy(recorded["intensity"].astype(np.float32)) / 255
    return Frame(torch.cat((xyz, intensity[:, None]), dim=1), id="recorded")


def recorded_names() -> list[str]:
    """Return the names of the weights whose outputs are recorded."""
    with np.load(RECORDED) as stored:
        return sorted({key.split(":")[0] for key in stored.files if ":" in key})


@pytest.mark.parametrize("name", recorded_names() if RECORDED.exists() else [])
def test_shipped_weights_compute_what_they_did(name: str) -> None:
    with np.load(RECORDED) as stored:
        recorded = {key: stored[key] for key in stored.files}
    found = beambox.load(name, device="cpu", precision="float32")(frame_of(recorded))
    assert len(found) == recorded[f"{name}:count"]
    torch.testing.assert_close(found.scores[:BEST], torch.from_numpy(recorded[f"{name}:scores"]), rtol=0, atol=1e-5)
    torch.testing.assert_close(found.boxes[:BEST], torch.from_numpy(recorded[f"{name}:boxes"]), rtol=1e-5, atol=1e-4)
    assert found.names[:BEST] == recorded[f"{name}:names"].tolist()


def record() -> None:
    """Record the outputs of all shipped weights on the sweep that is there: simulated once, seed 5, frame 900002."""
    with np.load(RECORDED) as stored:
        recorded = {key: stored[key] for key in ("xyz", "intensity")}
    for name in sorted(shipped()):
        found = beambox.load(name, device="cpu", precision="float32")(frame_of(recorded))
        recorded[f"{name}:count"] = np.array(len(found))
        recorded[f"{name}:scores"] = found.scores[:BEST].numpy()
        recorded[f"{name}:boxes"] = found.boxes[:BEST].numpy()
        recorded[f"{name}:names"] = np.array(found.names[:BEST])
    np.savez_compressed(RECORDED, **recorded)


if __name__ == "__main__":
    record()
