"""What no configuration may ask for: numbers come from recipes and weight files, and those may be anybody's."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from torch import Tensor, nn
from torch.nn.modules import module as torch_module

from beambox.checks import BeamboxError

__all__ = ["MOST_ELEMENTS", "bounded", "check_numbers"]

MOST = 1_000_000
"""No count and no length of a network is larger."""
MAY_BE_ZERO = {
    "d",
    "depths",
    "e",
    "head_depth",
    "m",
    "n",
    "query_range",
    "train_least",
}
"""Counts that may be 0 (d, e, m, n: KASSD's keypoints); all others are at least 1."""
MAY_BE_NEGATIVE = {"bottom_z", "maximum", "minimum"}
"""Numbers that may lie below 0: places in space."""
ABOVE_ZERO = {"radii", "radius", "size", "smooth_l1_beta"}
"""Lengths that cannot be 0."""
MOST_ELEMENTS = 250_000_000
"""Values in all parameters and buffers of a network: 1 GB of float32, thirty times the published networks."""
MOST_TENSORS = 10_000
"""Parameters and buffers of a network; the published ones have a few hundred."""


def check_numbers(options: Mapping[str, Any], field: str = "", place: str = "") -> None:
    """Check that every number of a configuration, given as plain values, can be meant.

    Raises:
        BeamboxError: for NaN, infinity, a negative or zero count, or a number that no network has, naming its place.
    """
    for key, value in options.items() if isinstance(options, Mapping) else enumerate(options):
        field, where = (key, f"{place}{key}") if isinstance(key, str) else (field, f"{place}{key}")
        if isinstance(value, Mapping | list | tuple):
            check_numbers(value, field, f"{where}.")  # pyright: ignore[reportArgumentType]
        elif isinstance(value, int) and not isinstance(value, bool):
            least = 0 if field in MAY_BE_ZERO else 1
            if not least <= value <= MOST:
                raise BeamboxError(f"`{where}` must lie between {least} and {MOST}, got {value:.6g}")
        elif isinstance(value, float):
            low = -MOST if field in MAY_BE_NEGATIVE else 0
            if not low <= value <= MOST or (value == 0 and field in ABOVE_ZERO):
                details = "above 0" if field in ABOVE_ZERO else f"of {low} to {MOST}"
                raise BeamboxError(f"`{where}` must be a number {details}, got {value}")


@contextmanager
def bounded(name: str, most: int = MOST_ELEMENTS) -> Iterator[None]:
    """Inside, a network of this thread is refused while it is built, before its memory is touched.

    Args:
        name: what the network is called in the message.
        most: values that its parameters and buffers may have together.

    Raises:
        BeamboxError: where it grows beyond ``most``, or its layers cannot be made at all.
    """
    thread, elements, tensors = threading.get_ident(), 0, 0

    def count(_module: nn.Module, _name: str, value: Tensor | None) -> None:
        nonlocal elements, tensors
        if value is None or threading.get_ident() != thread:
            return
        elements, tensors = elements + value.numel(), tensors + 1
        if elements > most or tensors > MOST_TENSORS:
            raise BeamboxError(
                f"these options make a {name} of more than {most:.3g} values, or {MOST_TENSORS} tensors: "
                "take smaller widths and depths"
            )

    hooks = (
        torch_module.register_module_parameter_registration_hook(count),
        torch_module.register_module_buffer_registration_hook(count),
    )
    try:
        yield
    except (RuntimeError, ArithmeticError, MemoryError) as error:  # torch's own words for a layer that cannot be
        details = str(error).partition("\n")[0] or type(error).__name__
        raise BeamboxError(
            f"these options make no {name} that can be built ({details}): check widths and depths"
        ) from error
    finally:
        for hook in hooks:
            hook.remove()
