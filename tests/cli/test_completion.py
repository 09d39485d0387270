"""Completion in a shell: what may follow, and that the script of bash really asks for it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from beambox.cli.commands import COMMANDS
from beambox.cli.completion import complete
from oracles.command_line import beambox


def test_commands_options_and_names_are_completed() -> None:
    assert set(COMMANDS) <= set(complete([""])) and complete(["det"]) == ["detect"] and complete(["nothing"]) == []
    assert "--model" in complete(["detect", "scan.bin", "--mo"]) and "--help" in complete(["detect", "-"])
    assert (
        complete(["detect", "--model", "pointpillars-s"])
        == ["pointpillars-sim"]
        == complete(["bench", "pointpillars-s"])
    )
    assert {"kitti", "once"} <= set(complete(["score", ""])) and "--labels" in complete(["score", "kitti", "--l"])
    assert "pointpillars-small" in complete(["train", "pointpillars-"])
    assert complete(["detect", ""]) == [] == complete(["nothing", "-"]), "files are the shell's to complete"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_completes_its_options(name: str) -> None:
    words = [name, ""] if name in ("data", "score") else [name, "-"]
    assert complete(words)


def test_an_unknown_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    ran = beambox(capsys, "completion", "bsh")
    assert ran.status == 2 and 'did you mean "bash"?' in ran.err


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_by_the_script(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    program = tmp_path / "beambox"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m beambox "$@"\n')
    program.chmod(0o755)
    script = beambox(capsys, "completion", "bash").out
    ask = 'COMP_WORDS=(beambox models pointpillars-s); COMP_CWORD=2; _beambox; echo "${COMPREPLY[@]}"'
    ran = subprocess.run(
        ["bash", "-c", f"{script}\n{ask}"], capture_output=True, text=True, check=True,
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert ran.stdout == "pointpillars-sim\n", ran.stderr
