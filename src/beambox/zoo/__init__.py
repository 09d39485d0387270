"""The shipped weights: one .safetensors file each, with its card inside and, for readers, beside it."""

from __future__ import annotations

from pathlib import Path

__all__ = ["DEFAULT", "shipped"]

DEFAULT = "pointpillars-sim"
"""What is taken where no weights are named: free for any use, as none of the others need be."""


def shipped() -> dict[str, Path]:
    """Return the file of each shipped set of weights, by name."""
    return {path.stem: path for path in sorted(Path(__file__).parent.glob("*.safetensors"))}
