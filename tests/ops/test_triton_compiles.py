"""Compile every Triton kernel to a GPU's machine code: this needs no GPU, and shows what the interpreter lets pass."""

import os
from importlib.util import find_spec

import pytest

pytestmark = [
    pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed; it is for Linux on x86-64"),
    pytest.mark.skipif(os.environ.get("TRITON_INTERPRET") == "1", reason="interpreted kernels cannot be compiled"),
]

AMPERE, HOPPER = 80, 90


def compile_kernel(kernel, **arguments):
    """Compile for given arguments: a text is the type of a run-time argument, anything else a constant."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    assert list(arguments) == kernel.arg_names, "give every argument, in order"
    types = {name: value if isinstance(value, str) else "constexpr" for name, value in arguments.items()}
    constants = {name: value for name, value in arguments.items() if not isinstance(value, str)}
    for chip in (AMPERE, HOPPER):
        compiled = triton.compile(ASTSource(kernel, types, constants), target=GPUTarget("cuda", chip, 32))
        assert compiled.asm["cubin"]


def test_overlaps_compile():
    from beambox.ops.rotated_iou import gpu

    compile_kernel(gpu._fill, a="*fp64", b="*fp64", out="*fp64", n="i32", m="i32", what=gpu.IOU_3D, tile=gpu.TILE)


def test_nms_compiles():
    from beambox.ops.nms import gpu

    sizes = {"overlaps": "*i64", "count": "*i64"}
    compile_kernel(
        gpu._mark, boxes="*fp64", **sizes, places="i32", words="i32", limit="*fp64", rows=gpu.ROWS
    )  # fmt: skip
    for width in (1, 64):
        compile_kernel(
            gpu._walk, **sizes, kept="*i64", number="*i64", places="i32", words="i32", post="i32", width=width
        )  # fmt: skip


@pytest.mark.parametrize(("values", "largest"), [("*fp32", True), ("*fp64", True), ("*bf16", False)])
def test_segments_compile(values, largest):
    import triton.language as tl

    from beambox.ops.scatter import gpu

    wide = tl.float64 if values == "*fp64" else tl.float32
    compile_kernel(
        gpu._reduce_segment, values=values, order="*i64", start="*i64", out=values, winner="*i64", rows="i32",
        columns="i32", largest=largest, wide=wide, block=64,
    )  # fmt: skip


def test_ball_count_compiles():
    from beambox.ops.ball_count import gpu

    compile_kernel(
        gpu._count, cells="*i64", column="*i64", z="*i64", steps="*i64", heights="*i64", out="*i64", voxels="i32",
        reach="i32", words=1, map_size="i32", radii="i32", block=gpu.BLOCK,
    )  # fmt: skip
    compile_kernel(
        gpu._stack, index="*i64", cells="*i64", column="*i64", z="*i64", voxels="i32", size="i32", low_b=0, low_z=0,
        low_y="i32", low_x="i32", height="i32", width="i32", pad_y="i32", pad_x="i32", block=gpu.BLOCK,
    )  # fmt: skip


@pytest.mark.parametrize(("kept", "given", "ones"), [("*fp32", "*fp32", False), ("*fp32", "*bf16", True)])
def test_attention_compiles(kept, given, ones):
    from beambox.ops.neighborhood import gpu

    size = 1 if ones else "i32"  # Triton makes a constant of every size that is 1
    sizes = {"heads": size, "height": "i32", "width": "i32", "depth": size, "window": 7, "block": gpu.BLOCK}
    sizes["deep"] = 1 if ones else 32
    compile_kernel(gpu._attend, q=given, k=given, v=given, bias=given, out=given, log_total=kept, **sizes)
    compile_kernel(
        gpu._to_queries, q=given, k=given, v=given, bias=given, log_total=kept, mean=kept, grad_out=given, weights=kept,
        grad_logits=kept, dq=given, **sizes,
    )  # fmt: skip
    compile_kernel(
        gpu._to_keys, q=given, weights=kept, grad_logits=kept, grad_out=given, dk=given, dv=given, row_low="*i64",
        row_high="*i64", **sizes,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("values", "bias", "widths"),
    [("*fp32", "*fp32", (16, 64)), ("*bf16", None, (64, 64)), ("*fp16", "*fp16", (16, 16))],
)
def test_sparse_convolution_compiles(values, bias, widths):
    from beambox.ops.sparse_conv import gpu

    sizes = {"rows": "i32", "offsets": "i32", "c_in": "i32", "c_out": "i32"}
    blocks = {"block": gpu.ROWS, "in_width": widths[0], "out_width": widths[1]}
    compile_kernel(
        gpu._forward, features=values, weight=values, bias=bias, table="*i32", out=values, **sizes, **blocks
    )  # fmt: skip
    compile_kernel(
        gpu._weight_grad, features=values, grad=values, table="*i32", parts="*fp32", **sizes, stretch="i32", **blocks
    )  # fmt: skip


def test_kernel_maps_compile():
    from beambox.ops.sparse_conv import gpu_indices, gpu_maps

    level = dict.fromkeys(("nz", "ny", "nx"), "i32")
    other = dict.fromkeys(("tz", "ty", "tx"), "i32")
    steps = {f"{name}{axis}": "i32" if name == "s" else 1 for name in "spd" for axis in "zyx"}
    keys = {"keys": "*i64", "order": "*i64", "target_keys": "*i64", "target_order": "*i64", "table": "*i32"}
    compile_kernel(
        gpu_maps._look_up, **keys, rows="i32", sources="i32", steps="i32", **other, **level, offsets="i32", ky="i32",
        kx="i32", **steps, block=gpu_maps.BLOCK,
    )  # fmt: skip
    compile_kernel(gpu_maps._turn_round, forward="*i32", back="*i32", total="i32", offsets="i32", block=1024)
    for listed, source in ((True, "*i64"), (False, "*i8")):
        compile_kernel(
            gpu_maps._spread, source=source, active="*i8", count="i32", listed=listed, **level, **other, kz="i32",
            ky="i32", kx="i32", **steps, block=gpu_maps.BLOCK,
        )  # fmt: skip
    compile_kernel(gpu_indices._take_apart, keys="*i64", order="*i64", indices="*i64", rows="i32", **level, block=256)


@pytest.mark.parametrize("values", ["*fp32", "*fp64"])
def test_voxel_query_compiles(values):
    from beambox.ops.voxel_query import gpu

    sizes = ("count", "sites", "steps", "nb", "nz", "ny", "nx", "rz", "ry", "rx", "max_samples")
    compile_kernel(
        gpu._search, points=values, cells="*i64", centers=values, keys="*i64", order="*i64", found="*i64", limit=values,
        **dict.fromkeys(sizes, "i32"), block=gpu.BLOCK,
    )  # fmt: skip


@pytest.mark.parametrize("values", ["*fp32", "*fp64"])
def test_voxelization_compiles(values):
    from beambox.ops.voxelize import gpu

    sizes = {"count": "i32", "row_step": "i32", "column_step": 1, "none": "i64", "nz": "i32", "ny": "i32", "nx": "i32"}
    compile_kernel(
        gpu._find_cells, points=values, sample="*i64", borders=values, key="*i64", **sizes, single=values == "*fp32",
        block=256,
    )  # fmt: skip
