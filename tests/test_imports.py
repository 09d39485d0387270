"""Importing is fast, quiet, and loads nothing heavy before it is needed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src"
MODULES = sorted(
    ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__")
    for path in (SOURCE / "beambox").rglob("*.py")
    if path.name != "__main__.py"
)
HEAVY = {"torch", "numpy", "numba", "matplotlib", "PIL", "pydantic", "scipy", "triton"}


def run(code: str, *options: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    return subprocess.run(
        [sys.executable, *options, "-c", code], env=environment, capture_output=True, text=True, check=True
    ).stdout


def loaded_after(statement: str) -> set[str]:
    code = f"import sys, json\n{statement}\nprint('\\n' + json.dumps(list(sys.modules)))"
    return {name.split(".")[0] for name in json.loads(run(code).splitlines()[-1])}


def test_importing_beambox_loads_nothing_heavy() -> None:
    assert not loaded_after("import beambox") & HEAVY


def test_help_loads_nothing_heavy_not_even_the_parser_of_commands() -> None:
    statement = "import beambox.cli.main as m\ntry:\n    m.main(['--help'])\nexcept SystemExit:\n    pass"
    assert not loaded_after(statement) & (HEAVY | {"typer", "rich"})


def test_help_answers_within_half_a_second_of_processor_time() -> None:
    code = (
        "import os\n"
        "from beambox.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "used = os.times()\nprint(used.user + used.system)"
    )
    assert float(run(code).splitlines()[-1]) < 0.5


def test_help_of_a_command_loads_no_network_library() -> None:
    statement = "import beambox.cli.main as m\ntry:\n    m.main(['detect', '--help'])\nexcept SystemExit:\n    pass"
    assert not loaded_after(statement) & HEAVY


def test_every_module_imports_without_a_warning() -> None:
    """In one process, each module freshly imported, warnings as errors (those of other packages aside)."""
    code = f"""
import importlib, warnings
warnings.filterwarnings("error", module="beambox")
warnings.filterwarnings("error", category=SyntaxWarning)
failed = []
for name in {MODULES!r}:
    try:
        importlib.import_module(name)
    except Exception as error:
        failed.append(f"{{name}}: {{type(error).__name__}} {{error}}")
print("\\n".join(failed))
"""
    assert run(code).strip() == ""


@pytest.mark.parametrize("name", ["beambox", "beambox.cli.main", "beambox.checks"])
def test_light_modules_import_alone(name: str) -> None:
    assert not loaded_after(f"import {name}") & HEAVY


@pytest.mark.parametrize("command", ["detect", "show", "doctor"])
def test_inputs_that_are_not_there_are_refused_before_torch_is_loaded(command: str) -> None:
    statement = (
        f"import beambox.cli.main as m\ntry:\n    m.main(['{command}', 'absent.bin'])\n"
        "except SystemExit as stopped:\n    assert stopped.code == 2"
    )
    assert not loaded_after(statement) & {"torch", "numpy", "numba", "PIL"}


def test_importing_beambox_takes_a_fifth_of_a_second_of_processor_time_at_most() -> None:
    code = "import os\nbefore = os.times()\nimport beambox\nused = os.times()\n"
    code += "print(used.user + used.system - before.user - before.system)"
    assert min(float(run(code)) for _ in range(3)) < 0.2
