"""Settings of all tests."""

import pytest
import torch
from hypothesis import HealthCheck, settings

# A busy machine is no failure; the same examples everywhere, so that a failure repeats.
settings.register_profile(
    "beambox", deadline=None, derandomize=True, max_examples=50, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("beambox")


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Small tensors on several threads mostly wait for each other; tests of threading set their own number."""
    torch.set_num_threads(1)
