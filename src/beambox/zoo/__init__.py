"""The shipped weights: one .safetensors file each, with its card inside and, for readers, beside it."""

from __future__ import annotations

from pathlib import Path

from beambox.checks import BeamboxError, MissingFileError, did_you_mean

__all__ = ["DEFAULT", "find_weights", "shipped"]

DEFAULT = "pointpillars-sim"
"""What is taken where no weights are named: free for any use, as none of the others need be."""


def shipped() -> dict[str, Path]:
    """Return the file of each shipped set of weights, by name."""
    return {path.stem: path for path in sorted(Path(__file__).parent.glob("*.safetensors"))}


def find_weights(name: str | Path) -> Path:
    """Find a weight file: a shipped name, a path, or the folder of a training run.

    Raises:
        BeamboxError: naming the nearest shipped name.
    """
    path = Path(name)
    if path.is_file():
        if path.suffix.lower() in (".pth", ".pt", ".ckpt"):
            raise BeamboxError(
                f"{path} is a PyTorch checkpoint; beambox reads .safetensors. One of OpenPCDet's is converted by "
                "`beambox import-openpcdet`; one of a training run lies beside its weights"
            )
        return path
    if path.is_dir():
        for file in ("best.safetensors", "final.safetensors"):
            if (path / file).is_file():
                return path / file
        found = sorted(path.glob("*.safetensors"))
        if len(found) == 1:
            return found[0]
        raise MissingFileError(f"{path} is a folder with {len(found)} weight files; name one (*.safetensors)")
    names = shipped()
    if str(name) in names:
        return names[str(name)]
    hint = did_you_mean(str(name), names) if names else "; none is shipped with this installation"
    raise MissingFileError(f'no weights are called "{name}" and no such file is there{hint}')
