"""Detection in a process that was forked.

PyTorch computes on threads of OpenMP. A fork copies the process, but none of its threads: where the parent had used
them, the child waits for ever at the first computation that would share its work. One thread needs no others.
"""

from __future__ import annotations

import logging
import os

import torch

__all__ = ["survive_fork"]

log = logging.getLogger("beambox")

_process = os.getpid()


def survive_fork() -> None:
    """Let a forked process compute on one thread, which works, instead of waiting for threads that are not there."""
    global _process  # noqa: PLW0603  # one value per process, and a fork copies it
    if os.getpid() == _process:
        return
    _process = os.getpid()
    if torch.get_num_threads() > 1:
        torch.set_num_threads(1)
        log.warning(
            "this process was forked from one that used PyTorch's threads, which do not survive a fork: it runs on 1 "
            'thread. Use spawn, as in multiprocessing.get_context("spawn"), to compute on more'
        )
