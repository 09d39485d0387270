"""Two small matrix products written in vector instructions, from which the CPU's sparse convolution is made.

Both hold a tile of four rows times a few vectors in registers and run down the summed dimension, one fused
multiply-add a lane and step, always in the same order: a result's bits depend neither on which rows share a tile nor on
the number of threads. Numba turns each into the host's own instructions; the lanes only choose the shape of the tile,
so that it fits the registers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from beambox.ops.vectors import INDEX, VECTOR_BYTES, WIDE, Emitter, Value

__all__ = ["ROWS", "VECTOR_BYTES", "WIDE", "multiply_rows", "outer_products"]

ROWS = 4
"""Rows of a tile."""


def _row_of(context: Any, builder: Any, kind: types.Array, rows: Value, place: Value) -> Value:
    """Load ``rows[place]`` of an int32 array as a 64-bit integer."""
    base = context.make_array(kind)(context, builder, rows).data
    return builder.sext(builder.load(builder.gep(base, [place])), INDEX)


def _data(context: Any, builder: Any, kind: types.Array, array: Value) -> tuple[Value, list[Value]]:
    """Return the address of a C-ordered array's first element and its extents."""
    view = context.make_array(kind)(context, builder, array)
    extents = cgutils.unpack_tuple(builder, view.shape, kind.ndim)
    return builder.ptrtoint(view.data, INDEX), extents


def _make_multiply_rows(across: int) -> Callable[..., Any]:
    @intrinsic
    def multiply_rows(typing: Any, x, weight, out, source, target, first, k, column):
        """``out[target[p], columns] += x[source[p]] @ weight[k][:, columns]`` for the four pairs p from ``first``."""
        signature = types.void(x, weight, out, source, target, types.int64, types.int64, types.int64)

        def emit(context: Any, builder: Any, sig: Any, args: Any) -> Value:
            kinds = sig.args
            emitter = Emitter(builder, kinds[0].dtype)
            x_base, (_, c_in) = _data(context, builder, kinds[0], args[0])
            w_base, (_, _, width) = _data(context, builder, kinds[1], args[1])
            out_base, _ = _data(context, builder, kinds[2], args[2])
            first, k, column = args[5:]
            sources, targets = [], []
            for row in range(ROWS):
                place = builder.add(first, INDEX(row))
                source = _row_of(context, builder, kinds[3], args[3], place)
                target = _row_of(context, builder, kinds[4], args[4], place)
                sources.append(emitter.address(x_base, builder.mul(source, c_in)))
                targets.append(emitter.address(out_base, builder.add(builder.mul(target, width), column)))
            totals = [[cgutils.alloca_once(builder, emitter.vector) for _ in range(across)] for _ in range(ROWS)]
            for row in range(ROWS):
                for v in range(across):
                    builder.store(emitter.load(targets[row], v), totals[row][v])
            weights = emitter.address(w_base, builder.add(builder.mul(builder.mul(k, c_in), width), column))
            with cgutils.for_range(builder, c_in, intp=INDEX) as step:
                line = emitter.address(weights, builder.mul(step.index, width))
                emitter.add_products(line, [emitter.address(one, step.index) for one in sources], totals)
            for row in range(ROWS):
                for v in range(across):
                    emitter.store(builder.load(totals[row][v]), targets[row], v)
            return context.get_dummy_value()

        return signature, emit

    return multiply_rows


def _make_outer_products(across: int) -> Callable[..., Any]:
    @intrinsic
    def outer_products(typing: Any, x, grad, out, source, target, first, count, k, channel, column):
        """``out[k][channels, columns] += sum over count pairs of outer(x[source][channels], grad[target][columns])``.

        Four channels from ``channel``; the pairs are added up on their own before they are added to ``out``.
        """
        integers = [types.int64] * 5
        signature = types.void(x, grad, out, source, target, *integers)

        def emit(context: Any, builder: Any, sig: Any, args: Any) -> Value:
            kinds = sig.args
            emitter = Emitter(builder, kinds[0].dtype)
            x_base, (_, c_in) = _data(context, builder, kinds[0], args[0])
            g_base, (_, width) = _data(context, builder, kinds[1], args[1])
            out_base, _ = _data(context, builder, kinds[2], args[2])
            first, count, k, channel, column = args[5:]
            totals = [[cgutils.alloca_once(builder, emitter.vector) for _ in range(across)] for _ in range(ROWS)]
            for row in range(ROWS):
                for v in range(across):
                    builder.store(ir.Constant(emitter.vector, None), totals[row][v])
            with cgutils.for_range(builder, count, intp=INDEX) as step:
                place = builder.add(first, step.index)
                source = _row_of(context, builder, kinds[3], args[3], place)
                target = _row_of(context, builder, kinds[4], args[4], place)
                x_line = emitter.address(x_base, builder.add(builder.mul(source, c_in), channel))
                g_line = emitter.address(g_base, builder.add(builder.mul(target, width), column))
                numbers = [builder.add(x_line, INDEX(row * emitter.bytes)) for row in range(ROWS)]
                emitter.add_products(g_line, numbers, totals)
            for row in range(ROWS):
                line = builder.add(builder.add(builder.mul(k, c_in), channel), INDEX(row))
                place = emitter.address(out_base, builder.add(builder.mul(line, width), column))
                for v in range(across):
                    total = builder.fadd(emitter.load(place, v), builder.load(totals[row][v]))
                    emitter.store(total, place, v)
            return context.get_dummy_value()

        return signature, emit

    return outer_products


multiply_rows = {across: _make_multiply_rows(across) for across in (1, 2, 4)}
"""By the number of vectors across."""
outer_products = {across: _make_outer_products(across) for across in (1, 2, 4)}
"""By the number of vectors across."""
