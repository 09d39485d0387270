"""Non-maximum suppression of rotated boxes in BEV."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_shape
from beambox.ops.dispatch import Backend, always, can_run_numba, can_run_triton, choose
from beambox.ops.nms import reference

__all__ = ["nms", "nms_of_samples"]


def _numba() -> Callable[..., Tensor]:
    from beambox.ops.nms import cpu

    return cpu.nms


def _triton() -> Callable[..., Tensor]:
    from beambox.ops.nms import gpu

    return gpu.nms


BACKENDS = (
    Backend("triton", can_run_triton, _triton),
    Backend("numba", can_run_numba, _numba),
    Backend("reference", always, lambda: reference.nms),
)


def _triton_of_samples() -> Callable[..., tuple[Tensor, Tensor]]:
    from beambox.ops.nms import gpu

    return gpu.nms_of_samples


OF_SAMPLES = (
    Backend("triton", can_run_triton, _triton_of_samples),
    Backend("reference", always, lambda: reference.nms_of_samples),
)


def nms(boxes: Tensor, scores: Tensor, threshold: float, pre: int = 4096, post: int = 500) -> Tensor:
    """Keep the best boxes that do not overlap a better kept one, whatever their class.

    Greedy, by falling score; of equal scores the first box goes first. A box is dropped if its bird's-eye-view IoU with
    a kept box is greater than the threshold. Boxes of NaN score are dropped. No gradient.

    Args:
        boxes: ``(N, 7)`` x, y, z, l, w, h, yaw; metres and radians.
        scores: ``(N,)``.
        threshold: IoU in [0, 1].
        pre: look only at so many boxes of the highest scores.
        post: keep at most so many.

    Returns:
        ``(K,)`` int64 rows of the kept boxes, best first.

    Raises:
        BeamboxError: if a shape does not fit, or a limit is negative.
    """
    expect_shape("boxes", boxes, (None, 7))
    expect_shape("scores", scores, (len(boxes),))
    if pre < 0 or post < 0:
        raise BeamboxError(f"`pre` and `post` must not be negative, got {pre} and {post}")
    boxes, scores = boxes.detach(), scores.detach()
    known = (~scores.isnan()).nonzero().squeeze(1)
    if post == 0 or pre == 0 or len(known) == 0:
        return torch.empty(0, dtype=torch.int64, device=boxes.device)
    kept = choose("nms", BACKENDS, boxes, scores)(boxes[known], scores[known], threshold, pre, post)
    return known[kept]


def nms_of_samples(boxes: Tensor, count: Tensor, threshold: float, post: int = 500) -> tuple[Tensor, Tensor]:
    """Keep the best boxes of each sample, as :func:`nms` does; sizes are fixed, so that no GPU is waited for.

    Args:
        boxes: ``(B, P, 7)``, each sample's best first.
        count: ``(B,)`` int64 how many of each sample's P there are; the others are not looked at.
        threshold: IoU in [0, 1].
        post: keep at most so many.

    Returns:
        ``(B, post)`` int64 places among the P of the kept boxes, best first, then -1; and ``(B,)`` int64 their numbers.

    Raises:
        BeamboxError: if a shape does not fit, or a limit is negative.
    """
    expect_shape("boxes", boxes, (None, None, 7))
    expect_shape("count", count, (len(boxes),))
    if post < 0:
        raise BeamboxError(f"`post` must not be negative, got {post}")
    return choose("nms_of_samples", OF_SAMPLES, boxes, count)(boxes.detach(), count, threshold, post)
