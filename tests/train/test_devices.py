"""The choice of precision."""

from __future__ import annotations

import sys

import pytest

from beambox.checks import BeamboxError
from beambox.infer.precision import bfloat16_reason
from beambox.train.devices import choose_precision, make_fabric


def test_auto_takes_bfloat16_only_where_it_is_native() -> None:
    import torch

    reason = bfloat16_reason(torch.device("cpu"), training=True)
    assert choose_precision("auto", "cpu") == ("float32" if reason else "bfloat16")
    assert choose_precision("bfloat16", "cpu") == "bfloat16"


def test_half_precision_on_a_cpu_is_refused() -> None:
    with pytest.raises(BeamboxError, match="float16 needs a GPU"):
        choose_precision("float16", "cpu")


def test_missing_fabric_is_said_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lightning_fabric", None)  # what an absent package does when imported
    with pytest.raises(BeamboxError, match=r'pip install "\.\[train\]"'):
        make_fabric("auto")
