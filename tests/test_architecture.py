"""Who may import whom, read from the syntax tree; and the size of files and functions."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "beambox"
FILES = sorted(PACKAGE.rglob("*.py"))

# folder -> folders it may import. All may import the ground floor (checks, io), and a folder itself.
MAY_IMPORT = {
    "geometry": set(),
    "structures": {"geometry"},
    "ops": {"geometry"},
    "layers": {"ops", "geometry"},
    "detectors": {"layers", "ops", "geometry", "structures", "zoo"},
    "data": {"structures", "geometry", "ops"},
    "metrics": {"structures", "geometry", "ops"},
    "simulate": {"structures", "geometry", "ops", "data", "metrics"},
    "visualize": {"structures", "geometry"},
    "infer": {"detectors", "data", "simulate", "metrics", "structures", "visualize", "geometry", "ops", "zoo"},
    "train": {"detectors", "data", "simulate", "metrics", "structures", "visualize", "geometry", "ops", "infer", "zoo"},
    "explain": {"infer", "detectors", "layers", "ops", "structures", "visualize", "geometry"},
    "report": {"infer", "data", "metrics", "visualize", "structures", "geometry", "ops", "zoo"},
    "export": {"detectors", "structures", "layers", "ops", "geometry"},
    "serve": {"infer", "data", "structures", "geometry"},
    "stream": {"track", "infer", "data", "structures", "geometry"},
    "track": {"infer", "data", "metrics", "structures", "geometry", "ops"},
    "zoo": set(),
}
# file -> folders that it may import besides, but inside its functions only: thin doors from a value to what draws and
# writes it, see docs/decisions.md.
MAY_DEFER = {"structures/conversions.py": {"visualize", "data"}}
GROUND_FLOOR = {"callable_package", "checks", "file_names", "io", "progress"}
GEOMETRY_MAY_USE = {"__future__", "math", "dataclasses", "collections", "typing", "torch", "beambox"}


def beambox_imports(tree: ast.AST) -> set[str]:
    """Return the top folders of beambox that a module imports."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "beambox":
            parts = node.module.split(".")
            found |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
        if isinstance(node, ast.Import):
            found |= {a.name.split(".")[1] for a in node.names if a.name.startswith("beambox.")}
    return found


def place(path: Path) -> str:
    """Return the folder of the package in which a file lies, or the name of a file at the top."""
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else path.stem


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_follow_the_table(path: Path) -> None:
    folder = place(path)
    used = beambox_imports(ast.parse(path.read_text(encoding="utf-8"))) - {folder, *GROUND_FLOOR, "__version__"}
    deferred = MAY_DEFER.get(path.relative_to(PACKAGE).as_posix(), set())
    if deferred:
        top = [node for node in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom)]
        assert not {name for node in top for name in beambox_imports(node)} & deferred, "inside functions only"
        used -= deferred
    if folder in MAY_IMPORT:
        assert used <= MAY_IMPORT[folder], f"{folder} must not import {sorted(used - MAY_IMPORT[folder])}"
    elif folder in GROUND_FLOOR:
        assert not used, f"{folder} lies on the ground floor and imports {sorted(used)}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_only_relative_free_and_starless_imports(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            assert all(alias.name != "*" for alias in node.names), "no star imports"


@pytest.mark.parametrize("path", [p for p in FILES if place(p) == "geometry"], ids=lambda p: p.name)
def test_geometry_is_plain_torch(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        assert {n.split(".")[0] for n in names} <= GEOMETRY_MAY_USE


@pytest.mark.parametrize("path", [p for p in FILES if place(p) == "cli"], ids=lambda p: str(p.relative_to(PACKAGE)))
def test_command_line_imports_nothing_heavy_at_module_level(path: Path) -> None:
    light = {*GROUND_FLOOR, "cli", "__version__"}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        assert beambox_imports(node) <= light if isinstance(node, ast.Import | ast.ImportFrom) else True
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        heavy = {n.split(".")[0] for n in names} & {"torch", "numpy", "numba", "matplotlib", "PIL", "pydantic"}
        assert not heavy, f"import {sorted(heavy)} inside the command's function"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_and_functions_stay_readable(path: Path) -> None:
    """A file has 400 lines, a paper 600; a function 50, signature and docstring apart."""
    text = path.read_text(encoding="utf-8")
    limit = 600 if place(path) == "detectors" else 400
    assert len(text.splitlines()) <= limit, f"longer than {limit} lines: look for the missing idea"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            body = node.body[1:] if ast.get_docstring(node) is not None and len(node.body) > 1 else node.body
            length = node.end_lineno - body[0].lineno + 1
            assert length <= 50, f"{node.name} is {length} lines long: it should fit a screen"


def test_no_file_needs_itself_to_be_imported() -> None:
    """No circle of imports that run when a file is imported, in any folder."""
    modules = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in FILES}
    modules = {name.removesuffix(".__init__"): path for name, path in modules.items()}
    imports: dict[str, set[str]] = {}
    for name, path in modules.items():
        found = set()
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("beambox"):
                parts = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= {part for part in parts if part in modules} or {node.module or ""}
        imports[name] = {other for other in found if other != name and other in modules}
    follow_all(imports)


def test_no_two_files_import_each_other() -> None:
    """No circle, also not inside a folder, through imports within functions, or for type checkers alone."""
    modules = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in FILES}
    modules = {name.removesuffix(".__init__"): path for name, path in modules.items()}
    imports: dict[str, set[str]] = {}
    for name, path in modules.items():
        found = set()
        if path.relative_to(PACKAGE).as_posix() in MAY_DEFER:
            imports[name] = (
                set()
            )  # values convert themselves by it, so it knows them too; what else it may is said above
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("beambox"):
                parts = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= {part for part in parts if part in modules} or {node.module or ""}
        known = {other for other in found if other != name and other in modules}
        imports[name] = {other for other in known if not other.startswith("beambox.structures")}
    imports["beambox"] = set()  # the frontend, which hands on what lies behind it
    follow_all({name: found for name, found in imports.items() if not name.startswith("beambox.structures")})


def follow_all(imports: dict[str, set[str]]) -> None:
    """Fail where a way along imports comes back to where it began."""
    done: set[str] = set()

    def follow(name: str, way: tuple[str, ...]) -> None:
        assert name not in way, " -> ".join((*way[way.index(name) :], name))
        if name in done:
            return
        for other in imports.get(name, ()):
            follow(other, (*way, name))
        done.add(name)

    for name in imports:
        follow(name, ())
