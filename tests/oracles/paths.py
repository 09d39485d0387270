"""Where tests find real scans and recorded references; they skip, with a reason, where these are absent."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def _folder(variable: str, default: str, *parts: str) -> Path:
    folder = Path(os.environ.get(variable, ROOT / ".." / "shared" / default)).joinpath(*parts)
    if not folder.exists():
        pytest.skip(f"{folder} is not there; set {variable} to the folder that holds it")
    return folder


def data_dir(*parts: str) -> Path:
    """Return the folder of real recordings (BEAMBOX_DATA), or skip the test."""
    return _folder("BEAMBOX_DATA", "data", *parts)


def fixtures_dir(*parts: str) -> Path:
    """Return the folder of recorded references (BEAMBOX_FIXTURES), or skip the test."""
    return _folder("BEAMBOX_FIXTURES", "fixtures", *parts)
