"""Settings of all tests."""

import os

os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
import torch


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Small tensors on several threads mostly wait for each other; tests of threading set their own number."""
    torch.set_num_threads(1)
