"""Counts what a piece of code gives a device to do, and where it waits for an answer; on any device."""

from __future__ import annotations

from collections import Counter
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

READS = (
    "_local_scalar_dense",
    "item",
    "equal",
    "is_nonzero",
    "nonzero",
    "masked_select",
    "unique_dim",
    "unique_consecutive",
    "unique_dim_consecutive",
    "_unique",
    "_unique2",
    "bincount",
)
"""Operations whose answer, or the size of it, the host waits for."""
NOTHING = ("detach_", "lift_fresh", "empty", "new_empty", "empty_like", "empty_strided", "new_empty_strided")
"""Operations that compute nothing: at most they take memory."""
TAKEN_HOME = ("tolist", "cpu", "numpy", "__array__")
"""Methods that hand a tensor's values to the host; where it lies there already, no operation shows it."""
SENT = ("tensor", "as_tensor", "from_numpy", "new_tensor", "asarray")
"""Functions that bring numbers of the host to a device, which waits for it as a reading does."""


class Launches(TorchDispatchMode):
    """Counts operations that compute (views do not), bytes they touch, and reads by the host.

    A copy to another device than the data's counts as a read where it goes to the CPU.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operations: Counter[str] = Counter()
        """By name."""
        self.reads: Counter[str] = Counter()
        """By name."""
        self.sent: Counter[str] = Counter()
        """Numbers brought from the host, by name."""
        self.home: dict[int, Tensor] = {}
        """What was brought home and what was made of it, by place; kept, so that nothing else comes to lie there."""
        self.bytes = 0
        """Of all arguments and results, as if each operation read and wrote every one once."""

    def __enter__(self) -> Launches:
        self._calls = _Calls(self)
        self._calls.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._calls.__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        name = func.overloadpacket._qualified_op_name.split("::")[-1]
        given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        outputs = [leaf for leaf in tree_leaves(out) if isinstance(leaf, Tensor)]
        if given and all(place_of(tensor) in self.home for tensor in given):  # the host's own work
            self.home.update((place_of(tensor), tensor) for tensor in outputs)
            return out
        if is_view(func) or name in NOTHING:
            return out
        self.operations[name] += 1
        self.bytes += sum(tensor.numel() * tensor.element_size() for tensor in (*given, *outputs))
        if name in READS or reads_by_mask(name, given) or goes_home(name, given, outputs):
            self.reads[name] += 1
        return out


class _Calls(TorchFunctionMode):
    """Tells of calls that move values between the host and a device, whatever device it is."""

    def __init__(self, launches: Launches) -> None:
        super().__init__()
        self.launches = launches

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        if (name in SENT and not isinstance(args[0], Tensor | type(None))) or name == "new_tensor":
            self.launches.sent[name] += 1
        out = func(*args, **(kwargs or {}))
        if name in TAKEN_HOME:
            home = self.launches.home
            if place_of(args[0]) not in home:  # what was brought home is read there without waiting
                self.launches.reads[name] += 1
            if name == "cpu":
                home[place_of(out)] = out
        return out


def place_of(tensor: Tensor) -> int:
    """Return where a tensor's values lie."""
    return tensor.untyped_storage().data_ptr()


def is_view(func: Any) -> bool:
    """Whether an operation only looks at its argument in another way."""
    results = func._schema.returns
    return bool(results) and all(r.alias_info is not None and not r.alias_info.is_write for r in results)


def reads_by_mask(name: str, given: list[Tensor]) -> bool:
    """Whether an indexing operation is given a mask, whose true places must be counted first."""
    return name in ("index", "index_put", "index_put_", "_index_put_impl_") and any(
        t.dtype in (torch.bool, torch.uint8) for t in given[1:]
    )


def goes_home(name: str, given: list[Tensor], outputs: list[Tensor]) -> bool:
    """Whether something is copied from a device to the CPU."""
    if name == "copy_":
        return given[0].device.type == "cpu" and given[-1].device.type != "cpu"
    return name == "_to_copy" and bool(outputs) and outputs[0].device.type == "cpu" and given[0].device.type != "cpu"
