"""Vector instructions of the host, for CPU kernels that numba's own loops are too slow for.

The lanes only choose the shape of what is held in registers, so that it fits; numba turns each instruction into the
host's own.
"""

from __future__ import annotations

import platform
from typing import Any, TypeAlias

import llvmlite.binding
from llvmlite import ir
from numba.core import cgutils, types

__all__ = ["INDEX", "VECTOR_BYTES", "WIDE", "Emitter", "Value"]


def _host() -> tuple[int, int]:
    """Return the bytes of a vector register and the most vectors across that a tile may hold."""
    machine = platform.machine().lower()
    if machine in ("aarch64", "arm64"):
        return 16, 4  # 32 registers
    features = llvmlite.binding.get_host_cpu_features()
    if features.get("avx512f"):
        return 64, 4  # 32 registers
    return (32, 2) if features.get("avx2") else (16, 2)  # 16 registers


VECTOR_BYTES, WIDE = _host()

INDEX = ir.IntType(64)
Value: TypeAlias = Any
"""llvmlite is not typed."""


class Emitter:
    """Emits instructions on vectors of one element type."""

    def __init__(self, builder: Any, element: types.Float) -> None:
        self.builder = builder
        self.bytes = element.bitwidth // 8
        self.scalar = ir.FloatType() if element.bitwidth == 32 else ir.DoubleType()
        self.lanes = VECTOR_BYTES // self.bytes
        self.vector = ir.VectorType(self.scalar, self.lanes)
        name = f"llvm.fmuladd.v{self.lanes}f{element.bitwidth}"
        kind = ir.FunctionType(self.vector, [self.vector] * 3)
        self._multiply_add = cgutils.get_or_insert_function(builder.module, kind, name)

    def address(self, base: Value, index: Value) -> Value:
        """Return the address of element ``index`` of an array that begins at ``base``."""
        return self.builder.add(base, self.builder.mul(index, INDEX(self.bytes)))

    def _vector_at(self, address: Value, column: int) -> Value:
        place = self.builder.add(address, INDEX(column * VECTOR_BYTES))
        return self.builder.inttoptr(place, self.vector.as_pointer())

    def load(self, address: Value, column: int) -> Value:
        """Load the vector ``column`` vectors behind an address."""
        return self.builder.load(self._vector_at(address, column), align=self.bytes)

    def store(self, value: Value, address: Value, column: int) -> None:
        """Store a vector ``column`` vectors behind an address."""
        self.builder.store(value, self._vector_at(address, column), align=self.bytes)

    def broadcast(self, address: Value) -> Value:
        """Load one number into every lane."""
        return self.spread(self.builder.load(self.builder.inttoptr(address, self.scalar.as_pointer())))

    def spread(self, value: Value) -> Value:
        """Put one number into every lane."""
        undefined = ir.Constant(self.vector, ir.Undefined)
        first = self.builder.insert_element(undefined, value, ir.IntType(32)(0))
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), None)
        return self.builder.shuffle_vector(first, undefined, everywhere)

    def add_products(self, line: Value, numbers: list[Value], totals: list[list[Value]]) -> None:
        """Add to each row of totals the vectors of a line, times the number at the row's address."""
        vectors = [self.load(line, v) for v in range(len(totals[0]))]
        for number, row in zip(numbers, totals):
            value = self.broadcast(number)
            for vector, total in zip(vectors, row):
                self.builder.store(self.multiply_add(value, vector, self.builder.load(total)), total)

    def multiply_add(self, a: Value, b: Value, total: Value) -> Value:
        """Return ``a * b + total``, fused where the host can."""
        return self.builder.call(self._multiply_add, [a, b, total])
