"""HCNet: point cloud object detection by height and channel attention (Zhang et al., Remote Sensing 13:5071, 2021).

One stage, 2-D convolutions only. Points are gathered into pillars cut into P slices of height; each slice gives a
pseudo image, height and channel attention merge the P images into one, and a head that sees that image again, and
weighs rows and columns of its own map, finds the boxes::

    points -> voxels -> PointNet -> P pseudo images -> HC module -> image -> backbone -> adaptive head -> boxes
              0.16 x 0.16 x 1 m     P = 4, 496 x 432   sect. 3.2-3.4    |    sect. 3.5    sect. 3.6
                                                                        +--------------------^

The paper reports, for cars on KITTI's validation split, 3-D AP 88.45 / 78.01 / 76.72 (easy / moderate / hard; 11
recalls) at 0.032 s on an RTX 2080 Ti. Weights trained on KITTI by its recipe are not available to compare with.

Where the paper is silent or contradicts itself (``docs/hcnet.md`` tells each at length):

* range: 70.4 x 80 m as printed does not fit 496 x 432 cells of 0.16 m (printed "90.16, 0.16, 10"); PointPillars'
  69.12 x 79.36 m does;
* the voxel network is only called "similar to PointNet": PointPillars' with 64 channels, shared by all slices, at most
  32 points per voxel;
* the product of the two attentions, "matrix multiplication", is read pixel by pixel: (C, 1) x (1, P); each pair of
  1 x 1 convolutions has a ReLU between them and 4 or 16 hidden channels (without it they would be one linear map).
  Weights lie in [0.5, 1), as a sigmoid follows two ReLUs;
* widths and depths of backbone and head appear nowhere: PointPillars', and 128 in the head;
* the "original pseudo images" that OIFM feeds into the head are taken to be the HC module's output; "a similar strategy
  as CBAM" to be CBAM with reduction 16 and a 7 x 7 kernel;
* AAM's convolutions are 3 x 1 and 1 x 3, and row and column weights are added; ReLU leaves the weights without a bound
  (``aam_gate`` sigmoid bounds them);
* equation 7 divides the height's difference by the anchor's diagonal while "the same loss function as SECOND" divides
  by its height: SECOND's; its sine belongs to the loss, not to the target;
* the anchors' height above the ground is missing: lower face at -1.78 m, as PointPillars;
* optimiser, length of training, flip and post-processing are missing: PointPillars' of the public toolbox (recipes).

Added: ``attention`` none (a plain maximum, which the paper's tables lack), any number of slices, several classes,
``centered_anchors`` and ``absolute_xy`` as in PointPillars.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError, choose_fields, chosen, expect_shape
from beambox.detectors.contract import detections_from, targets_from
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import AnchorClass, AnchorGrid
from beambox.layers.bev import (
    BN_EPS,
    BN_MOMENTUM,
    conv_bn_relu,
    deconv_bn_relu,
    enlarge_and_join,
    join_levels,
    mean_over,
)
from beambox.layers.heads import AnchorHead, AnchorPredictions, LossWeights, PostProcess, anchor_loss, select_boxes
from beambox.layers.pillars import PillarFeatures
from beambox.ops.dispatch import Backend, always, can_run_graph, can_run_triton, choose, needs_gradient
from beambox.ops.scatter import scatter_bev
from beambox.ops.voxelize import Voxels, voxelize
from beambox.structures.batch import Batch
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = [
    "CBAM",
    "HCNET_CAR",
    "HCNET_SLICES",
    "AdaptiveAdjustment",
    "Gate",
    "HCNet",
    "HCNetConfig",
    "HeightChannelFusion",
    "HeightChannelKind",
    "hcnet",
    "pillar_stacks",
    "pseudo_images",
]


HCNET_SLICES = VoxelGrid((0.0, -39.68, -3.0), (69.12, 39.68, 1.0), (0.16, 0.16, 1.0))
"""432 x 496 pillars of four slices in front of the sensor (HCNet, section 4.2; range see the module)."""

HCNET_CAR = AnchorClass("Car", (3.9, 1.6, 1.5), -1.78, 0.60, 0.45)
"""HCNet's car (section 4.2; the height above the ground is PointPillars')."""

Three = tuple[int, int, int]


class HeightChannelKind(str, Enum):
    """Which attention weighs the pseudo images before they are merged (HCNet, table 3)."""

    NONE = "none"
    """No weights: the plain maximum over the slices."""
    CHANNEL = "CA"
    """One weight a channel, the same in all slices."""
    HEIGHT = "HA"
    """One weight a slice, the same in all channels."""
    BOTH = "HCA"
    """A weight for each channel and slice: the product of the two attentions."""


class Gate(str, Enum):
    """What turns the adjustment module's convolutions into weights."""

    RELU = "relu"
    """ReLU of each convolution, then the sum: not bounded above (as published)."""
    SIGMOID = "sigmoid"
    """Sum of the convolutions, then one sigmoid: weights between 0 and 1."""


NAMES_SINCE = {f"adapt.{fuse}.weigh.": f"adapt.{fuse}.reweight." for fuse in ("fuse1", "fuse2")}
"""What began the names of tensors in 0.1.0 -> what begins them now."""


@dataclass(frozen=True)
class HCNetConfig:
    """Everything that defines the network; the defaults are the published KITTI setting, cars only."""

    anchors: tuple[AnchorClass, ...] = (HCNET_CAR,)
    """One anchor shape per class; also the classes and their order."""
    grid: VoxelGrid = HCNET_SLICES
    """Region in metres and voxel size; the number of cells in z is the number of pseudo images P."""
    max_points: int = 32
    """Points kept in a voxel, in scan order."""
    max_voxels: int | None = 60000
    """Voxels kept in a sweep, in order of first appearance; None keeps all."""
    num_point_features: int = 4
    """Values of a point: x, y, z, intensity, ..."""
    voxel_channels: int = 64
    """Width C of the voxel features and pseudo images."""
    absolute_xy: bool = True
    """Whether a point's absolute x and y are among its features."""
    attention: HeightChannelKind = HeightChannelKind.BOTH
    """Weights of the pseudo images before their maximum: none, CA, HA or HCA (table 3)."""
    height_hidden: int = 4
    """Hidden channels of the height attention."""
    channel_hidden: int = 16
    """Hidden channels of the channel attention."""
    depths: Three = (3, 5, 5)
    """Convolutions of each stage after its first."""
    strides: Three = (2, 2, 2)
    """Stride of each stage's first convolution; the first is the stride of the anchors."""
    widths: Three = (64, 128, 256)
    """Channels of each stage."""
    up_widths: Three = (128, 128, 128)
    """Channels that each level contributes to the backbone's output."""
    head_depth: int = 3
    """Convolutions of the head's block after its first."""
    head_width: int = 128
    """Channels of the head's block, of its deblock and of the branch beside them."""
    oifm: bool = True
    """Whether the original information-fusion module feeds the pseudo image into the head (table 4)."""
    oifm_width: int = 64
    """Channels of the shrunken pseudo image."""
    cbam_reduction: int = 16
    """Channels of the fusion over hidden channels of its channel weights."""
    aam: bool = True
    """Whether the adaptive-adjustment module weighs the head's map (table 4)."""
    aam_gate: Gate = Gate.RELU
    """From convolutions to weights in it: relu (as published) or sigmoid."""
    centered_anchors: bool = False
    """Whether anchors stand at the centres of the map's cells."""
    loss: LossWeights = field(default_factory=LossWeights)
    """Weights of the losses (section 3.7: loc 2, cls 1, dir 0.2)."""
    smooth_l1_beta: float = 1 / 9
    """Where the regression loss turns linear."""
    post: PostProcess = field(default_factory=PostProcess)
    """Post-processing at test time."""

    def __post_init__(self) -> None:
        choose_fields(self)
        if not self.anchors:
            raise BeamboxError("`anchors` must name at least one class, got none")
        of_stages = {"depths": self.depths, "strides": self.strides, "widths": self.widths, "up_widths": self.up_widths}
        for name, values in of_stages.items():
            if len(values) != 3:
                raise BeamboxError(f"`{name}` must have 3 entries, one per stage, got {len(values)}: {list(values)}")

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes."""
        return tuple(anchor.name for anchor in self.anchors)

    @property
    def slices(self) -> int:
        """Number of height slices, P in the paper."""
        return self.grid.size[2]


class HCNet(nn.Module):
    """The network; see :class:`HCNetConfig`.

    ``model(batch)`` takes a :class:`Batch` of sweeps and returns :class:`AnchorPredictions` over the map of stride 2.
    With ``oifm`` or ``aam`` on, weights depend on averages over the whole map: the same place predicted from another
    region (``grid``) may differ a little.
    """

    def __init__(self, config: HCNetConfig) -> None:
        super().__init__()
        self.config = config
        width = config.voxel_channels
        self.anchors = AnchorGrid(config.anchors, config.grid, config.strides[0], config.centered_anchors)
        self.voxel_net = PillarFeatures(width, config.num_point_features, config.absolute_xy)
        self.fuse_slices = HeightChannelFusion(
            width, config.slices, config.attention, config.height_hidden, config.channel_hidden
        )
        self.backbone = PyramidBackbone(width, config.depths, config.strides, config.widths, config.up_widths)
        self.adapt = AdaptiveHead(
            self.backbone.out_channels,
            width,
            config.strides[0],
            config.head_width,
            config.head_depth,
            OriginalInformation(config.oifm_width, config.cbam_reduction) if config.oifm else None,
            config.aam_gate if config.aam else None,
        )
        self.head = AnchorHead(self.adapt.out_channels, self.anchors)

    def forward(
        self, batch: Batch, grid: VoxelGrid | None = None, labels: Sequence[Labels] | None = None
    ) -> AnchorPredictions:
        """Predict over the configured region, or over ``grid``, which must have cells of the same size.

        ``labels`` are for networks with a second step; they change nothing here.
        """
        return self.from_voxels(self.voxels(batch, self.config.grid if grid is None else grid))

    def from_voxels(self, voxels: Voxels) -> AnchorPredictions:
        """Predict from points that are already gathered into voxels."""
        features = self.voxel_net(voxels)  # (V, C)
        stacks, pillars = pillar_stacks(features, voxels)  # (M, P, C), (M, 4)
        fused = self.fuse_slices(stacks)  # (M, C)
        image = scatter_bev(fused, pillars, voxels.batch_size, voxels.grid.shape[1:])  # (B, C, ny, nx)
        bev = self.backbone(image)  # (B, 3 * 128, ny / 2, nx / 2)
        adapted = self.adapt(bev, image)  # (B, 2 * 128, ny / 2, nx / 2)
        return self.head(adapted, voxels.grid)

    @property
    def dense(self) -> tuple[nn.Module, ...]:
        """Layers that work on whole maps."""
        return self.backbone, self.adapt

    def voxels(self, batch: Batch, grid: VoxelGrid) -> Voxels:
        """Gather points into voxels."""
        config = self.config
        if grid.size[2] != config.slices:
            raise BeamboxError(f"`grid` must have the {config.slices} height slices of the network, got {grid.size[2]}")
        points = batch.points[:, : config.num_point_features]
        return voxelize(points, batch.sample, batch.size, grid, config.max_points, config.max_voxels)

    def loss(self, predictions: AnchorPredictions, labels: Sequence[Labels]) -> dict[str, Tensor]:
        """Return the weighted losses ``cls``, ``loc`` and ``direction``; objects of other classes are background."""
        config = self.config
        boxes, classes = targets_from(labels, config.classes, predictions.cls.device)
        return anchor_loss(predictions, boxes, classes, self.anchors, config.loss, config.smooth_l1_beta)

    def decode(self, predictions: AnchorPredictions) -> list[Detections]:
        """Return the detections of each sample, best first."""
        return detections_from(select_boxes(predictions, self.config.post), self.config.classes)


def pillar_stacks(features: Tensor, voxels: Voxels) -> tuple[Tensor, Tensor]:
    """Put the voxels that stand above each other side by side; only pillars that hold a voxel appear.

    Args:
        features: ``(V, C)`` one row per voxel.
        voxels: what they describe, on a grid of N height slices.

    Returns:
        ``(M, N, C)`` features of each occupied pillar, slices from the lowest up, zero where a slice is empty; and
        ``(M, 4)`` int64 (sample, 0, y, x) of the pillars.
    """
    return choose("pillar_stacks", STACK_BACKENDS, features)(features, voxels)


def one_stack_a_pillar(features: Tensor, voxels: Voxels) -> tuple[Tensor, Tensor]:
    """Do as :func:`pillar_stacks` says."""
    nx, ny, slices = voxels.grid.size
    sample, z, y, x = voxels.index.unbind(dim=1)
    distinct, pillar = ((sample * ny + y) * nx + x).unique(return_inverse=True)  # (M,), (V,)
    channels = features.shape[1]
    flat = features.new_zeros(len(distinct) * slices, channels)
    stacks = flat.index_copy(0, pillar * slices + z, features).view(len(distinct), slices, channels)  # (M, N, C)
    rows = torch.div(distinct, nx, rounding_mode="floor")  # (M,) sample * ny + y
    of_sample = torch.div(rows, ny, rounding_mode="floor")
    return stacks, torch.stack((of_sample, torch.zeros_like(rows), rows % ny, distinct % nx), dim=1)


def one_stack_a_voxel(features: Tensor, voxels: Voxels) -> tuple[Tensor, Tensor]:
    """Do as :func:`pillar_stacks` in a graph whose sizes are known before its values: M is V, the number of voxels.

    The first voxel of each pillar holds the pillar's stack; the stacks of the others are zero.
    """
    nx, ny, slices = voxels.grid.size
    sample, z, y, x = voxels.index.unbind(dim=1)
    count, channels = features.shape
    cell = (sample * ny + y) * nx + x  # (V,)
    row = torch.arange(count, device=cell.device)
    first = cell.new_full((voxels.batch_size * ny * nx,), count).scatter_reduce(0, cell, row, "amin")
    pillar = first[cell]  # (V,) row of the pillar's first voxel
    place = (pillar * slices + z)[:, None].expand_as(features)
    stacks = features.new_zeros(count * slices, channels).scatter(0, place, features).view(count, slices, channels)
    return stacks, torch.stack((sample, torch.zeros_like(z), y, x), dim=1)


def _can_run_on_gpu(features: Tensor) -> str | None:
    """Return why stacks of zeros should not stand in for a number of pillars that a GPU would be waited for."""
    if needs_gradient(features):
        return "a gradient is asked for, and sizes are read in training anyway"
    return can_run_triton(features)


STACK_BACKENDS = (
    Backend("graph", can_run_graph, lambda: one_stack_a_voxel),
    Backend("triton", _can_run_on_gpu, lambda: one_stack_a_voxel),
    Backend("reference", always, lambda: one_stack_a_pillar),
)


def pseudo_images(features: Tensor, voxels: Voxels) -> Tensor:
    """Lay each height slice onto its own image, zero elsewhere (HCNet, section 3.2): ``(B, C, H, W, N)``.

    At HCNet's published size this is 219 MB per sweep; the network uses :func:`pillar_stacks`.
    """
    nx, ny, slices = voxels.grid.size
    images = []
    for z in range(slices):
        in_slice = voxels.index[:, 1] == z
        image = scatter_bev(features[in_slice], voxels.index[in_slice], voxels.batch_size, (ny, nx))  # (B, C, H, W)
        images.append(image[..., None])
    return torch.cat(images, dim=-1)  # (B, C, H, W, N)


class HeightChannelFusion(nn.Module):
    """HCNet's HC block and attention-weighted block (sections 3.3 and 3.4): N pseudo images become one.

    Each pixel weighs its slices and channels by two small networks, of the maximum over channels (height attention)
    and of the maximum over slices (channel attention), two 1 x 1 convolutions each; the weighted slices are merged by
    their maximum. No pixel looks at another, and where all slices are empty the result is zero. So it is enough to
    compute occupied pillars, which is what calling the module does; :meth:`dense` computes every pixel as the paper
    writes it. Features must not be negative (they come from a ReLU), or empty slices would win the maximum in both.
    """

    def __init__(
        self,
        channels: int,
        slices: int,
        kind: HeightChannelKind | str,
        height_hidden: int = 4,
        channel_hidden: int = 16,
    ) -> None:
        super().__init__()
        self.kind = kind = chosen("kind", kind, HeightChannelKind)
        self.slices = slices
        uses_height = kind in (HeightChannelKind.HEIGHT, HeightChannelKind.BOTH)
        uses_channel = kind in (HeightChannelKind.CHANNEL, HeightChannelKind.BOTH)
        self.height = mlp(slices, height_hidden) if uses_height else None
        self.channel = mlp(channels, channel_hidden) if uses_channel else None

    def forward(self, stacks: Tensor) -> Tensor:
        """Merge the slices of each pillar: ``(M, N, C)``, no value negative, to ``(M, C)``."""
        expect_shape("stacks", stacks, (None, self.slices, None))
        height = None if self.height is None else self.height(stacks.amax(dim=2))  # (M, N)
        channel = None if self.channel is None else self.channel(stacks.amax(dim=1))  # (M, C)
        if height is not None and channel is not None:
            weight = torch.sigmoid(height[:, :, None] * channel[:, None, :])  # (M, N, C)
        elif height is not None:
            weight = torch.sigmoid(height)[:, :, None]
        elif channel is not None:
            weight = torch.sigmoid(channel)[:, None, :]
        else:
            return stacks.amax(dim=1)
        return (weight * stacks).amax(dim=1)

    def dense(self, images: Tensor) -> Tensor:
        """Merge pseudo images ``(B, C, H, W, N)`` into ``(B, C, H, W)`` by equations 1 to 3, every pixel of them."""
        expect_shape("images", images, (None, None, None, None, self.slices))
        return (self.attention(images) * images).amax(dim=4)

    def attention(self, images: Tensor) -> Tensor:
        """Return the weights of equation 3, ``(B, C, H, W, N)``, each in [0.5, 1); 1 where the kind is none."""
        by_height = images.amax(dim=1)  # (B, H, W, N)
        by_channel = images.amax(dim=4).permute(0, 2, 3, 1)  # (B, H, W, C)
        height = torch.ones_like(by_height) if self.height is None else self.height(by_height)
        channel = torch.ones_like(by_channel) if self.channel is None else self.channel(by_channel)
        product = channel[..., :, None] @ height[..., None, :]  # (B, H, W, C, 1) x (B, H, W, 1, N)
        weight = torch.ones_like(product) if self.kind is HeightChannelKind.NONE else torch.sigmoid(product)
        return weight.permute(0, 3, 1, 2, 4)


def mlp(width: int, hidden: int) -> nn.Sequential:
    """Two 1 x 1 convolutions with ReLU, on the last axis; the result is at least 0.

    The paper names no initialisation, and PyTorch's shuts a ReLU for good in every second network: inputs are not
    negative, so a unit whose few weights and bias came out negative gives 0 and no gradient, whatever it sees. Both
    start open here, hidden units by a bias of 0.5, results near 1: all slices and channels weigh sigmoid(1) = 0.73.
    """
    first, last = nn.Linear(width, hidden), nn.Linear(hidden, width)
    nn.init.constant_(first.bias, 0.5)
    nn.init.normal_(last.weight, std=0.05)
    nn.init.ones_(last.bias)
    return nn.Sequential(first, nn.ReLU(), last, nn.ReLU())


class PyramidBackbone(nn.Module):
    """The YOLO-like backbone (section 3.5, figure 7): down three stages, back up beside them, all levels joined."""

    def __init__(self, in_channels: int, depths: Three, strides: Three, widths: Three, up_widths: Three) -> None:
        super().__init__()
        (w1, w2, w3), (_, s2, s3) = widths, strides
        self.block1 = block(in_channels, w1, depths[0], strides[0])
        self.block2 = block(w1, w2, depths[1], s2)
        self.block3 = block(w2, w3, depths[2], s3)
        self.deblock3 = deblock(w3, w2, s3)
        self.deblock2 = deblock(w2 + w2, w1, s2)
        self.up1 = deconv_bn_relu(w1 + w1, up_widths[0], 1, 1)
        self.up2 = deconv_bn_relu(w2 + w2, up_widths[1], s2, s2)
        self.up3 = deconv_bn_relu(w3, up_widths[2], s2 * s3, s2 * s3)
        self.out_channels = sum(up_widths)

    def forward(self, image: Tensor) -> Tensor:
        """Map ``(B, in_channels, Y, X)`` to ``(B, out_channels, Y / s, X / s)``, s the first stage's stride."""
        top1 = self.block1(image)  # (B, 64, Y / 2, X / 2)
        top2 = self.block2(top1)  # (B, 128, Y / 4, X / 4)
        top3 = self.block3(top2)  # (B, 256, Y / 8, X / 8)
        down2 = join_levels((top2, self.deblock3(top3)))  # (B, 256, Y / 4, X / 4)
        down1 = join_levels((top1, self.deblock2(down2)))  # (B, 128, Y / 2, X / 2)
        return enlarge_and_join((self.up1, self.up2, self.up3), (down1, down2, top3))  # (B, 384, Y / 2, X / 2)


@dataclass(frozen=True)
class OriginalInformation:
    """What the original information-fusion module is made of."""

    width: int = 64
    """Channels of the shrunken pseudo image."""
    reduction: int = 16
    """Of its channel weights."""


class OriginalFusion(nn.Module):
    """The original information-fusion module (section 3.6.2): join the shrunken pseudo image, weigh by CBAM."""

    def __init__(self, channels: int, image_channels: int, strides: Sequence[int], of: OriginalInformation) -> None:
        super().__init__()
        steps = [conv_bn_relu(image_channels, of.width, stride=strides[0])]
        steps += [conv_bn_relu(of.width, of.width, stride=stride) for stride in strides[1:]]
        self.shrink = nn.Sequential(*steps)
        self.out_channels = channels + of.width
        self.reweight = CBAM(self.out_channels, of.reduction)

    def forward(self, bev: Tensor, image: Tensor) -> Tensor:
        """Map ``(B, channels, Y / s, X / s)`` and the image ``(B, C, Y, X)`` to ``(B, out_channels, Y / s, X / s)``."""
        return self.reweight(join_levels((bev, self.shrink(image))))


class AdaptiveHead(nn.Module):
    """The adaptively adjusted head before its last convolutions (section 3.6, figure 8); both modules are optional."""

    def __init__(
        self,
        in_channels: int,
        image_channels: int,
        stride: int,
        width: int,
        depth: int,
        original: OriginalInformation | None,
        gate: Gate | None,
    ) -> None:
        super().__init__()
        wide, deep = in_channels, width
        self.fuse1, self.fuse2 = None, None
        if original is not None:
            self.fuse1 = OriginalFusion(in_channels, image_channels, (stride,), original)
            self.fuse2 = OriginalFusion(width, image_channels, (stride, 2), original)
            wide, deep = self.fuse1.out_channels, self.fuse2.out_channels
        self.skip = conv_bn_relu(wide, width, kernel=1)
        self.block = block(wide, width, depth, 2)
        self.deblock = deblock(deep, width, 2)
        self.out_channels = 2 * width
        self.adjust = None if gate is None else AdaptiveAdjustment(self.out_channels, gate)

    def forward(self, bev: Tensor, image: Tensor) -> Tensor:
        """Map ``(B, in_channels, Y / s, X / s)``, with the pseudo image ``(B, C, Y, X)``, to ``out_channels``."""
        bev = bev if self.fuse1 is None else self.fuse1(bev, image)  # (B, 384 + 64, Y / 2, X / 2)
        deep = self.block(bev)  # (B, 128, Y / 4, X / 4)
        deep = deep if self.fuse2 is None else self.fuse2(deep, image)  # (B, 128 + 64, Y / 4, X / 4)
        both = join_levels((self.skip(bev), self.deblock(deep)))  # (B, 256, Y / 2, X / 2)
        return both if self.adjust is None else self.adjust(both)


class CBAM(nn.Module):
    """Weigh channels, then places (CBAM: Woo et al., ECCV 2018, section 3).

    The channel weights depend on means and maxima over the whole map, so the answer at a place depends on the region.
    """

    def __init__(self, channels: int, reduction: int = 16, kernel: int = 7) -> None:
        super().__init__()
        hidden = max(4, channels // reduction)  # a narrow map keeps a few, lest ReLU shut the only one
        self.channel = nn.Sequential(
            nn.Linear(channels, hidden, bias=False), nn.ReLU(), nn.Linear(hidden, channels, bias=False)
        )
        self.place = nn.Sequential(
            nn.Conv2d(2, 1, kernel, padding=kernel // 2, bias=False),
            nn.BatchNorm2d(1, eps=BN_EPS, momentum=BN_MOMENTUM),
        )

    def forward(self, bev: Tensor) -> Tensor:
        """Return ``(B, C, Y, X)`` weighed, of the same shape."""
        mean, largest = bev.mean(dim=(2, 3)), bev.amax(dim=(2, 3))  # (B, C)
        bev = bev * torch.sigmoid(self.channel(mean) + self.channel(largest))[:, :, None, None]
        places = torch.cat((bev.mean(dim=1, keepdim=True), bev.amax(dim=1, keepdim=True)), dim=1)  # (B, 2, Y, X)
        return bev * torch.sigmoid(self.place(places))


class AdaptiveAdjustment(nn.Module):
    """HCNet's adaptive-adjustment module: weigh a map by what its rows and columns hold (equations 4 to 6).

    Rows and columns are averaged over the whole map, so the answer at a place depends on the region.
    """

    def __init__(self, channels: int, gate: Gate | str = Gate.RELU, kernel: int = 3) -> None:
        super().__init__()
        if kernel % 2 == 0:
            raise BeamboxError(f"`kernel` must be odd, so that rows and columns keep their number, got {kernel}")
        self.gate = gate = chosen("gate", gate, Gate)
        self.rows = strip_conv(channels, (kernel, 1), gate)
        self.columns = strip_conv(channels, (1, kernel), gate)

    def forward(self, bev: Tensor) -> Tensor:
        """Return ``(B, C, Y, X)`` weighed, of the same shape."""
        rows = self.rows(mean_over(bev, 3))  # (B, C, Y, 1), equation 4
        columns = self.columns(mean_over(bev, 2))  # (B, C, 1, X), equation 5
        weight = rows + columns  # (B, C, Y, X)
        return bev * (torch.sigmoid(weight) if self.gate is Gate.SIGMOID else weight)  # equation 6


def strip_conv(channels: int, kernel: tuple[int, int], gate: Gate) -> nn.Sequential:
    """Convolution along a strip and batch norm; ReLU where it is the gate."""
    padding = (kernel[0] // 2, kernel[1] // 2)
    layers: list[nn.Module] = [
        nn.Conv2d(channels, channels, kernel, padding=padding, bias=False),
        nn.BatchNorm2d(channels, eps=BN_EPS, momentum=BN_MOMENTUM),
    ]
    return nn.Sequential(*layers, nn.ReLU()) if gate is Gate.RELU else nn.Sequential(*layers)


def block(in_channels: int, width: int, depth: int, stride: int) -> nn.Sequential:
    """A convolution with a stride and ``depth`` further ones, 3 x 3."""
    return nn.Sequential(
        conv_bn_relu(in_channels, width, stride=stride), *(conv_bn_relu(width, width) for _ in range(depth))
    )


def deblock(in_channels: int, width: int, stride: int) -> nn.Sequential:
    """A transposed 3 x 3 convolution that undoes a stride."""
    return deconv_bn_relu(in_channels, width, 3, stride, padding=1, output_padding=stride - 1)


def hcnet(config: HCNetConfig | None = None) -> HCNet:
    """Build HCNet; without a configuration, the published KITTI one for cars (7.1 M parameters)."""
    return HCNet(config or HCNetConfig())
