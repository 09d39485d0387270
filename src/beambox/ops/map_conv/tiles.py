"""The three inner loops of convolutions of maps, written in vector instructions on plain addresses (float32).

:data:`products` multiplies six gathered rows with a panel of weights that is at most four vectors wide: 24 sums stay in
registers over all taps of a kernel. :data:`transform_input` and :data:`transform_output` are the additions before and
after Winograd's products. All work on rows found by a table of addresses, in an order that depends on nothing but the
sizes, so that a result's bits depend neither on its neighbours in the table nor on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from numba.core import cgutils, types
from numba.extending import intrinsic

from beambox.ops.vectors import INDEX, VECTOR_BYTES, WIDE, Emitter, Value

__all__ = ["LANES", "ROWS", "WIDE", "products", "transform_input", "transform_output"]

ROWS = 6
"""Rows multiplied together: 6 x 4 sums, 4 weights and a value are 29 of 32 registers (6 x 2 of 16 without AVX-512)."""
LANES = VECTOR_BYTES // 4
"""Floats of a vector."""

_POINTER = INDEX.as_pointer()


def _table(builder: Any, table: Value, first: Value, count: int) -> list[Value]:
    """Load ``count`` addresses from place ``first`` on."""
    base = builder.inttoptr(table, _POINTER)
    return [builder.load(builder.gep(base, [builder.add(first, INDEX(i))])) for i in range(count)]


def _floored(builder: Any, value: Value, floor: Value) -> Value:
    """Return the larger of each lane and ``floor``; a NaN stays, as in PyTorch's ReLU."""
    return builder.select(builder.fcmp_ordered("<", value, floor), floor, value)


def _make_products(across: int) -> Callable[..., Any]:
    @intrinsic
    def products(typing: Any, rows, taps, channels, weights, start, targets, column, floor):
        """``target[r][column:] = max(floor, start + sum over taps t and channels c of row[t][r][c] * weights[t][c])``.

        ``rows`` is the address of a table of ``taps`` times six addresses, ``targets`` of six; ``weights`` of a panel
        ``(taps, channels, across)``, ``start`` of a vector group; ``column`` is in bytes.
        """
        signature = types.void(*[types.int64] * 7, types.float32)

        def emit(context: Any, builder: Any, sig: Any, args: Any) -> Value:
            emitter = Emitter(builder, types.float32)
            rows, taps, channels, weights, start, targets, column, floor = args
            floor = emitter.spread(floor)
            totals = [[cgutils.alloca_once(builder, emitter.vector) for _ in range(across)] for _ in range(ROWS)]
            for v in range(across):
                value = emitter.load(start, v)
                for row in range(ROWS):
                    builder.store(value, totals[row][v])
            with cgutils.for_range(builder, taps, intp=INDEX) as tap:
                lines = _table(builder, rows, builder.mul(tap.index, INDEX(ROWS)), ROWS)
                panel = builder.mul(builder.mul(tap.index, channels), INDEX(across * VECTOR_BYTES))
                panel = builder.add(weights, panel)
                with cgutils.for_range(builder, channels, intp=INDEX) as step:
                    line = builder.add(panel, builder.mul(step.index, INDEX(across * VECTOR_BYTES)))
                    emitter.add_products(line, [emitter.address(one, step.index) for one in lines], totals)
            for row, target in enumerate(_table(builder, targets, INDEX(0), ROWS)):
                place = builder.add(target, column)
                for v in range(across):
                    emitter.store(_floored(builder, builder.load(totals[row][v]), floor), place, v)
            return context.get_dummy_value()

        return signature, emit

    return products


products = {across: _make_products(across) for across in (1, 2, 3, 4)}
"""By the number of vectors across."""


def _each_vector(builder: Any, channels: Value) -> Any:
    """Loop over vectors of so many channels; where they are no whole number of vectors, the last overlaps."""
    count = builder.udiv(builder.add(channels, INDEX(LANES - 1)), INDEX(LANES))
    return cgutils.for_range(builder, count, intp=INDEX)


def _byte_of(builder: Any, step: Value, channels: Value) -> Value:
    first = builder.mul(step, INDEX(LANES))
    last = builder.sub(channels, INDEX(LANES))
    return builder.mul(builder.select(builder.icmp_signed("<", first, last), first, last), INDEX(4))


def _rows_in(builder: Any, d: Sequence[Value]) -> list[Value]:
    """Apply ``B^T`` to four values: d0 - d2, d1 + d2, d2 - d1, d1 - d3."""
    return [builder.fsub(d[0], d[2]), builder.fadd(d[1], d[2]), builder.fsub(d[2], d[1]), builder.fsub(d[1], d[3])]


def _rows_out(builder: Any, m: Sequence[Value]) -> list[Value]:
    """Apply ``A^T`` to four values: m0 + m1 + m2, m1 - m2 - m3."""
    both, apart = builder.fadd(m[1], m[2]), builder.fsub(m[1], m[2])
    return [builder.fadd(m[0], both), builder.fsub(apart, m[3])]


@intrinsic
def _transform_input(typing: Any, rows, channels, out, stride):  # pyright: ignore
    """Write ``B^T d B`` of the 4 x 4 cells in the table ``rows`` to 16 rows that lie ``stride`` bytes apart."""
    signature = types.void(*[types.int64] * 4)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Value:
        emitter = Emitter(builder, types.float32)
        rows, channels, out, stride = args
        cells = _table(builder, rows, INDEX(0), 16)
        with _each_vector(builder, channels) as step:
            at = _byte_of(builder, step.index, channels)
            d = [emitter.load(builder.add(cell, at), 0) for cell in cells]
            by_column = [_rows_in(builder, [d[4 * y + x] for y in range(4)]) for x in range(4)]
            for y in range(4):
                for x, value in enumerate(_rows_in(builder, [by_column[x][y] for x in range(4)])):
                    place = builder.add(out, builder.mul(stride, INDEX(4 * y + x)))
                    emitter.store(value, builder.add(place, at), 0)
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def _transform_output(typing: Any, source, stride, channels, start, targets, floor):  # pyright: ignore
    """Write ``max(floor, start + A^T m A)`` of 16 rows ``stride`` bytes apart to the 2 x 2 cells ``targets``."""
    signature = types.void(*[types.int64] * 5, types.float32)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Value:
        emitter = Emitter(builder, types.float32)
        source, stride, channels, start, targets, floor = args
        floor = emitter.spread(floor)
        cells = _table(builder, targets, INDEX(0), 4)
        with _each_vector(builder, channels) as step:
            at = _byte_of(builder, step.index, channels)
            base = builder.add(source, at)
            m = [emitter.load(builder.add(base, builder.mul(stride, INDEX(i))), 0) for i in range(16)]
            by_column = [_rows_out(builder, [m[4 * y + x] for y in range(4)]) for x in range(4)]
            begin = emitter.load(builder.add(start, at), 0)
            for y in range(2):
                for x, value in enumerate(_rows_out(builder, [by_column[x][y] for x in range(4)])):
                    rectified = _floored(builder, builder.fadd(value, begin), floor)
                    emitter.store(rectified, builder.add(cells[2 * y + x], at), 0)
        return context.get_dummy_value()

    return signature, emit


transform_input: Any = _transform_input
transform_output: Any = _transform_output
