"""Fold batch norms into the convolutions before them: in evaluation mode the two are one linear map."""

from __future__ import annotations

import copy
from typing import TypeVar

from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval

from beambox.detectors.contract import Foldable

__all__ = ["fold_batch_norms"]


M = TypeVar("M", bound=nn.Module)


def fold_batch_norms(model: M) -> M:
    """Return a copy of a model for inference, with fewer passes over its maps.

    In every :class:`~torch.nn.Sequential`, a convolution (or linear layer) directly followed by a batch norm takes the
    norm's scale and shift into its weights; the norm becomes an identity, so that names of layers stay. Layers that
    know how to fold themselves (:class:`beambox.detectors.contract.Foldable`) are asked to.

    Args:
        model: in any mode; neither it nor its mode is changed. The copy is in evaluation mode.
    """
    folded = copy.deepcopy(model).eval()  # batch statistics are only constant in evaluation mode
    for part in folded.modules():
        if isinstance(part, Foldable):
            part.fold()
    for chain in folded.modules():
        if not isinstance(chain, nn.Sequential):
            continue
        for place in range(len(chain) - 1):
            layer, norm = chain[place], chain[place + 1]
            if isinstance(norm, nn.BatchNorm2d) and isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
                chain[place] = fuse_conv_bn_eval(layer, norm, transpose=isinstance(layer, nn.ConvTranspose2d))
                chain[place + 1] = nn.Identity()
            elif isinstance(norm, nn.BatchNorm1d) and isinstance(layer, nn.Linear):
                chain[place] = fuse_linear_bn_eval(layer, norm)
                chain[place + 1] = nn.Identity()
    return folded
