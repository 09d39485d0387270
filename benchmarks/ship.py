"""Pack a run's weights for shipping: float16, with the card that stands beside them inside.

    python benchmarks/ship.py run/final.safetensors src/beambox/zoo/pointpillars-sim.yaml

writes ``src/beambox/zoo/pointpillars-sim.safetensors``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import yaml

from beambox.detectors.weights import load_weights, save_weights


def ship(weights: Path, card: Path) -> Path:
    """Write the weights beside their card, under its name."""
    target = card.with_suffix(".safetensors")
    entries = yaml.safe_load(card.read_text(encoding="utf-8"))
    save_weights(target, load_weights(weights), entries, half=True)
    return target


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    print(ship(Path(sys.argv[1]), Path(sys.argv[2])))
