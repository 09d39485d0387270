"""docs/backends.md names every operation, and says of each kind of backend whether there is one."""

from __future__ import annotations

import ast
from importlib import import_module
from inspect import isfunction

import pytest

from oracles.paths import ROOT

OPS = ROOT / "src" / "beambox" / "ops"
FOLDERS = sorted(path.parent.name for path in OPS.glob("*/__init__.py"))
DOORS = {"sparse_conv": "sparse_conv3d", "find_targets": "kernel_map"}
"""Functions that users call, where the choice of a backend has another name."""
NO_CHOICE = {"linear_keys", "learning_ground", "pooled"}
PART_OF = {"backends": "TARGET_BACKENDS", "able": "BACKENDS", "pooling": "POOLED_BACKENDS"}
"""Lists that a size or type may shorten at run time, by the name of the variable."""


def rows() -> dict[str, list[str]]:
    """Return the cells (reference, numba, Triton, gradient) of each operation."""
    lines = (ROOT / "docs" / "backends.md").read_text(encoding="utf-8").splitlines()
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| `")]
    return {name: cells for first, *cells in table for name in first.split("`")[1::2]}


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_operation_has_a_row(folder: str) -> None:
    module = import_module(f"beambox.ops.{folder}")
    functions = {name for name in module.__all__ if isfunction(vars(module)[name])} - NO_CHOICE
    assert functions
    assert functions <= set(rows())


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_row_says_which_versions_there_are(folder: str) -> None:
    module = import_module(f"beambox.ops.{folder}")
    for node in ast.walk(ast.parse((OPS / folder / "__init__.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "choose":
            operation, backends = node.args[:2]
            assert isinstance(operation, ast.Constant) and isinstance(backends, ast.Name)
            _, numba, triton, _ = rows()[DOORS.get(str(operation.value), str(operation.value))]
            listed = PART_OF.get(backends.id, backends.id)
            kinds = {backend.name for backend in vars(module)[listed]}
            assert ("numba" in kinds) == (not numba.startswith("the reference")), operation.value
            assert ("triton" in kinds) == (not triton.startswith("the reference")), operation.value
