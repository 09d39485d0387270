"""Operations on the device against their references on the CPU in float64, forward and every gradient."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from gpu_items import Item, Setting
from torch import Tensor

LIMIT = {torch.float64: 1e-10, torch.float32: 1e-4, torch.bfloat16: 2e-2, torch.float16: 4e-3}
"""Largest error, relative to the norm of the reference."""


def error(actual: Tensor, want: Tensor) -> float:
    """Return the norm of the difference over the norm of the reference; NaN passes nothing."""
    actual, want = actual.detach().cpu().double(), want.detach().cpu().double()
    if actual.shape != want.shape:
        raise AssertionError(f"shape {tuple(actual.shape)}, reference {tuple(want.shape)}")
    size = float(want.norm())
    return float((actual - want).norm()) / (size or 1.0)


def seeded(seed: int = 0) -> torch.Generator:
    """Return a source of random numbers."""
    return torch.Generator().manual_seed(seed)


def compare(
    ours: Callable[..., Tensor], twin: Callable[..., Tensor], inputs: Sequence[Tensor], device: str, limit: float
) -> dict[str, Any]:
    """Run ours on the device and its twin on the CPU in float64; compare outputs and gradients by every input."""
    mine = [value.detach().to(device, copy=True).requires_grad_() for value in inputs]
    theirs = [value.detach().double().clone().requires_grad_() for value in inputs]
    actual, want = ours(*mine), twin(*theirs)
    errors = {"forward": error(actual, want)}
    if want.numel() and want.requires_grad:
        cotangent = torch.randn(want.shape, generator=seeded(5), dtype=torch.float64)
        actual.backward(cotangent.to(actual))
        want.backward(cotangent.to(actual.dtype).double())
        for place, (a, b) in enumerate(zip(mine, theirs)):
            assert a.grad is not None and b.grad is not None
            errors[f"gradient {place}"] = error(a.grad, b.grad)
    worst = max(errors.values())
    return {"ok": worst <= limit, "worst": worst, "limit": limit, "errors": errors}


def exact(actual: Tensor, want: Tensor) -> dict[str, Any]:
    """Compare whole numbers."""
    actual, want = actual.cpu(), want.cpu()
    if actual.shape != want.shape:
        return {"ok": False, "shapes": [list(actual.shape), list(want.shape)]}
    wrong = int((actual != want).sum())
    return {"ok": wrong == 0, "wrong": wrong, "of": want.numel()}


def scatter(setting: Setting) -> list[Item]:
    """Reductions over groups of rows."""
    from beambox.ops import scatter as frontend
    from beambox.ops.scatter import reference

    frontends = {
        "sum": (frontend.segment_sum, reference.segment_sum),
        "mean": (frontend.segment_mean, reference.segment_mean),
        "max": (frontend.segment_max, reference.segment_max),
    }
    sizes = ((0, 3, 4), (1, 1, 1), (40, 7, 13), (30, 130, 4), (5000, 64, 1200))

    def one(name: str, rows: int, columns: int, size: int, dtype: torch.dtype) -> dict[str, Any]:
        values = torch.randn(rows, columns, generator=seeded(rows)).to(dtype)
        values = torch.where(torch.rand(rows, columns, generator=seeded(1)) < 0.3, 0.5, values)  # ties
        segment = torch.randint(0, max(size, 1), (rows,), generator=seeded(2))
        ours, twin = frontends[name]
        on_device = segment.to(setting.device)
        return compare(
            lambda v: ours(v, on_device, size), lambda v: twin(v, segment, size), [values], setting.device, LIMIT[dtype]
        )

    items: list[Item] = []
    for name in frontends:
        for dtype in (torch.float32, torch.float64, torch.bfloat16):
            for size in sizes:
                if dtype == torch.bfloat16 and name == "mean" and size[0] == 5000:
                    continue  # a running sum in bfloat16 is what the sum is tested on
                items.append((f"{name} {dtype} {size}", lambda n=name, d=dtype, s=size: one(n, *s, d)))

    def bev() -> dict[str, Any]:
        index = torch.randperm(2 * 30 * 40, generator=seeded(3))[:500]
        cells = torch.stack((index // 1200, index * 0, index % 1200 // 40, index % 40), dim=1)
        features = torch.randn(500, 64, generator=seeded(4))
        there = cells.to(setting.device)
        return compare(
            lambda f: frontend.scatter_bev(f, there, 2, (30, 40)),
            lambda f: reference.scatter_bev(f, cells, 2, (30, 40)),
            [features],
            setting.device,
            1e-6,
        )

    return [*items, ("scatter_bev", bev)]


def boxes(setting: Setting) -> list[Item]:
    """Overlaps, suppression, points in boxes."""
    from beambox.ops import rotated_iou as frontend
    from beambox.ops.nms import nms
    from beambox.ops.nms import reference as plain_nms
    from beambox.ops.points_in_boxes import points_in_boxes, points_in_boxes_mask
    from beambox.ops.points_in_boxes import reference as plain_points
    from beambox.ops.rotated_iou import reference
    from oracles.clouds import fan, random_boxes

    device = setting.device

    def overlap(name: str, rows: int, columns: int) -> dict[str, Any]:
        a, b = random_boxes(max(rows, 1), seeded(1), 4), random_boxes(max(columns, 1), seeded(2), 4)
        b[0] = a[0]
        a, b = a[:rows], b[:columns]
        actual = getattr(frontend, name)(a.to(device), b.to(device)).cpu()
        want = getattr(reference, name)(a, b)
        worst = float((actual - want).abs().max()) if want.numel() else 0.0
        return {"ok": actual.shape == want.shape and worst < 1e-8, "worst": worst, "limit": 1e-8}

    def suppress(count: int, threshold: float, pre: int, post: int) -> dict[str, Any]:
        given = random_boxes(count, seeded(count), 30, torch.float32) if count else torch.zeros(0, 7)
        scores = torch.rand(count, generator=seeded(3))
        actual = nms(given.to(device), scores.to(device), threshold, pre, post)
        return {**exact(actual, plain_nms.nms(given, scores, threshold, pre, post)), "kept": len(actual)}

    def inside(mask: bool) -> dict[str, Any]:
        points, given = fan(3000, seeded(1)), random_boxes(20, seeded(2), 30, torch.float32)
        ours, twin = (
            (points_in_boxes_mask, plain_points.points_in_boxes_mask)
            if mask
            else (points_in_boxes, plain_points.points_in_boxes)
        )
        return exact(ours(points.to(device), given.to(device)), twin(points, given))

    sizes = ((1, 1), (0, 5), (5, 0), (40, 37), (33, 500))
    return [
        *(
            (f"{name} {size}", lambda n=name, s=size: overlap(n, *s))
            for name in ("iou_bev", "iou_3d", "intersection_bev")
            for size in sizes
        ),
        *(
            (f"nms {case}", lambda c=case: suppress(*c))
            for case in (
                (0, 0.1, 10, 10),
                (1, 0.1, 10, 10),
                (64, 0.01, 4096, 500),
                (300, 0.5, 100, 20),
                (2048, 0.7, 2048, 100),
                (3000, 0.1, 4096, 500),
            )
        ),
        ("points_in_boxes", lambda: inside(False)),
        ("points_in_boxes_mask", lambda: inside(True)),
    ]


def sparse_conv(setting: Setting) -> list[Item]:
    """Sparse convolutions: maps, products, gradients."""
    from beambox.layers.encoders import mean_voxels
    from beambox.ops.sparse_conv import ConvSpec, SparseTensor, kernel_map, reference, sparse_conv3d, submanifold_conv3d
    from beambox.ops.sparse_conv import inverse_conv3d as back
    from beambox.ops.sparse_conv.pairs import input_rows
    from beambox.ops.voxelize import voxelize
    from oracles.sparse_conv import random_sparse

    device = setting.device
    kinds = {"submanifold": ConvSpec.centered((3, 3, 3)), "strided": ConvSpec((3, 3, 3), (2, 2, 2), (1, 1, 1))}
    kinds["uneven"] = ConvSpec((3, 1, 2), (2, 1, 2), (0, 0, 1))

    def there(x: SparseTensor, dtype: torch.dtype) -> SparseTensor:
        return SparseTensor.of(x.features.to(device, dtype), x.indices.to(device), x.shape, x.batch_size)

    def case(kind: str, dtype: torch.dtype, density: float, c_in: int, c_out: int, inverse: bool) -> dict[str, Any]:
        spec = kinds[kind]
        x = random_sparse(1, (7, 9, 8), 2, density, c_in, torch.float32)
        kernel = torch.randn((*spec.kernel, c_in, c_out), generator=seeded(2)) / (3 * c_in**0.5)
        bias = torch.randn(c_out, generator=seeded(3))
        values, kernel, bias = (t.to(dtype) for t in (x.features, kernel, bias))
        how = (spec.stride, spec.padding)

        def run(sparse: SparseTensor, f: Tensor, w: Tensor, b: Tensor) -> Tensor:
            given = sparse.with_features(f)
            if kind == "submanifold":
                return submanifold_conv3d(given, w, b).features
            down = sparse_conv3d(given, w, b, *how)
            return back(down, w.transpose(3, 4), sparse.sites, None, *how).features if inverse else down.features

        on_device = there(x, dtype)
        plain = SparseTensor.of(x.features.double(), x.indices, x.shape, x.batch_size)
        limit = LIMIT[dtype] * (3 if inverse else 1)
        return compare(
            lambda f, w, b: run(on_device, f, w, b),
            lambda f, w, b: run(plain, f, w, b),
            [values, kernel, bias],
            device,
            limit,
        )

    def maps() -> dict[str, Any]:
        x = random_sparse(4, (9, 20, 21), 3, 0.1, 1, torch.float32, empty=(1,))
        here = there(x, torch.float32)
        results = []
        for spec in kinds.values():
            actual, want = kernel_map(here.sites, spec), kernel_map(x.sites, spec)
            results += [
                exact(actual.target.indices, want.target.indices),
                exact(actual.kept(input_rows), want.kept(input_rows)),
            ]
            results += [exact(actual.inverse.kept(input_rows), want.inverse.kept(input_rows))]
        return {"ok": all(r["ok"] for r in results), "parts": results}

    def sweep(dtype: torch.dtype) -> dict[str, Any]:
        from beambox.detectors.second import KITTI_VOXELS

        batch = setting.batch(1)
        voxels = mean_voxels(voxelize(batch.points, batch.sample, 1, KITTI_VOXELS, 5, 40000))
        spec = kinds["submanifold"]
        values = torch.randn(len(voxels.features), 64, generator=seeded(6)).to(dtype)
        weight = (torch.randn((27, 64, 64), generator=seeded(7)) / 24).to(dtype)
        here = there(replace(voxels, features=values.float()), dtype)
        pairs, plain = kernel_map(here.sites, spec), kernel_map(voxels.sites, spec)
        from beambox.ops.sparse_conv import _convolve

        return {"voxels": len(values)} | compare(
            lambda f, w: _convolve(f, w.unflatten(0, (3, 3, 3)), None, pairs),
            lambda f, w: reference.convolve(f, w, None, plain),
            [values, weight],
            device,
            LIMIT[dtype],
        )

    cases = [
        (kind, dtype, density, c_in, c_out, inverse)
        for kind, inverse in (("submanifold", False), ("strided", False), ("uneven", False), ("strided", True))
        for dtype in (torch.float32, torch.bfloat16, torch.float16, torch.float64)
        for density, c_in, c_out in ((0.4, 5, 7), (0.1, 16, 64), (0.05, 1, 20))
    ]
    if device == "cpu":
        cases = [one for one in cases if one[1] in (torch.float32, torch.float64)]
    halves = (torch.bfloat16, torch.float16)  # of these one size a kind: compiling takes most of the time
    cases = [one for one in cases if one[1] not in halves or (one[3] == 16 and one[0] != "uneven")]
    return [
        ("kernel maps", maps),
        *((" ".join(map(str, one)), lambda c=one: case(*c)) for one in cases),
        *((f"a sweep, {dtype}", lambda d=dtype: sweep(d)) for dtype in (torch.float32, torch.bfloat16)),
    ]


def attention(setting: Setting) -> list[Item]:
    """Neighbourhood attention."""
    from beambox.ops.neighborhood import neighborhood_attention, reference

    def one(shape: tuple[int, ...], window: int, dtype: torch.dtype) -> dict[str, Any]:
        parts = [torch.randn(shape, generator=seeded(i)).to(dtype) for i in range(3)]
        parts.append((torch.randn(shape[1], 2 * window - 1, 2 * window - 1, generator=seeded(4)) / 2).to(dtype))
        return compare(
            lambda *p: neighborhood_attention(*p, window),
            lambda *p: reference.neighborhood_attention(*p, window),
            parts,
            setting.device,
            LIMIT[dtype],
        )

    shapes = [((1, 1, 7, 9, 5), 7), ((2, 1, 3, 34, 3), 3), ((1, 2, 1, 2, 1), 1), ((2, 4, 30, 37, 16), 7)]
    shapes += [((1, 2, 50, 44, 32), 7)]
    dtypes = (torch.float32, torch.float64, torch.bfloat16)
    if setting.device == "cpu":
        dtypes = dtypes[:2]
    return [
        (f"{shape} {window} {dtype}", lambda s=shape, w=window, d=dtype: one(s, w, d))
        for dtype in dtypes
        for shape, window in shapes
    ]


def density(setting: Setting) -> list[Item]:
    """Ball counts and voxel queries."""
    from beambox.ops.ball_count import ball_count
    from beambox.ops.ball_count import reference as plain_count
    from beambox.ops.sparse_conv import Sites
    from beambox.ops.voxel_query import reference as plain_query
    from beambox.ops.voxel_query import voxel_query

    def count(voxels: int, levels: int, radius: float) -> dict[str, Any]:
        index = torch.stack([torch.randint(0, n, (voxels,), generator=seeded(n)) for n in (2, levels, 40, 41)], dim=1)
        index[:, 1] -= 7
        actual = ball_count(index.to(setting.device), (0.1, 0.1, 0.15), radius)
        return exact(actual, plain_count.ball_count(index, (0.1, 0.1, 0.15), radius))

    def query(points: int, density: float, samples: int) -> dict[str, Any]:
        shape = (9, 40, 44)
        active = torch.nonzero(torch.rand((2, *shape), generator=seeded(1)) < density)
        active = active[torch.randperm(len(active), generator=seeded(2))]
        size = torch.tensor([0.4, 0.4, 0.8])
        centers = (active[:, 1:].flip(1) + 0.5) * size
        where = torch.rand(points, 3, generator=seeded(3)) * 20 - torch.tensor([1.0, 1.0, 5.0])
        cells = torch.cat((torch.arange(points)[:, None] % 2, (where / size).floor().long().flip(1)), dim=1)
        cells = cells[cells[:, 0].argsort(stable=True)]
        there = [t.to(setting.device) for t in (where, cells, active, centers)]
        actual = voxel_query(there[0], there[1], Sites.of(there[2], shape, 2), there[3], (2, 3, 3), 1.2, samples)
        sites = Sites.of(active, shape, 2)
        return exact(actual, plain_query.voxel_query(where, cells, sites, centers, (2, 3, 3), 1.2, samples))

    counts = ((1, 5, 0.3), (100, 40, 0.15), (2000, 40, 0.3), (3000, 130, 0.6))
    queries = ((1, 0.2, 16), (0, 0.1, 4), (500, 0.0, 4), (3000, 0.02, 16), (3000, 0.3, 5))
    return [
        *((f"ball_count {c}", lambda c=c: count(*c)) for c in counts),
        *((f"voxel_query {q}", lambda q=q: query(*q)) for q in queries),
    ]


def voxels(setting: Setting) -> list[Item]:
    """Voxels and what is read off them."""
    from beambox.geometry.grid import VoxelGrid
    from beambox.ops.voxelize import reference, voxelize

    grid = VoxelGrid((0, -8, -3), (16, 8, 1), (0.4, 0.4, 0.5))

    def one(count: int, max_points: int | None, max_voxels: int | None) -> dict[str, Any]:
        points = torch.rand(count, 4, generator=seeded(1)) * torch.tensor([18.0, 18.0, 5.0, 1.0])
        points = points - torch.tensor([1.0, 9.0, 3.5, 0.0])
        if count > 10:
            points[3, 1], points[4, 0] = torch.nan, torch.inf
        sample = torch.arange(count) // (count // 3 + 1)
        actual = voxelize(points.to(setting.device), sample.to(setting.device), 3, grid, max_points, max_voxels)
        want = reference.voxelize(points, sample, 3, grid, max_points, max_voxels)
        parts = [exact(getattr(actual, n), getattr(want, n)) for n in ("points", "voxel", "count", "index")]
        return {"ok": all(part["ok"] for part in parts), "parts": parts}

    return [
        (f"voxelize {case}", lambda c=case: one(*c))
        for case in ((0, 5, 10), (1, None, None), (3000, 3, 500), (3000, None, None), (20000, 5, 100000))
    ]


GROUPS: dict[str, Callable[[Setting], list[Item]]] = {
    "scatter": scatter,
    "boxes": boxes,
    "sparse_conv": sparse_conv,
    "attention": attention,
    "density": density,
    "voxels": voxels,
}
