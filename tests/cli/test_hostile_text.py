"""Names and messages come from files and may hold anything: terminals, pages and pictures show them and obey none."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from beambox import Detections, Frame, Labels
from beambox.checks import did_you_mean, printable
from beambox.cli.console import LONGEST_LINE, log, plain, plain_output
from beambox.cli.main import guard
from beambox.visualize.viewer import viewer_html
from oracles.command_line import beambox
from oracles.tiny_detector import street, tiny_weights

HOSTILE = "\x1b[2J\x1b]0;title\x07\x9b31m\r\x08\u202ecar"
LONG = "x" * 200_000


def test_what_steers_a_terminal_is_written_as_an_escape() -> None:
    shown = printable(HOSTILE)
    assert shown == r"\x1b[2J\x1b]0;title\x07\x9b31m\r\x08\u202ecar" and shown.isprintable()
    assert printable("Wagen 1:\n\tgrün 車") == "Wagen 1:\n\tgrün 車"
    assert printable("a\udce9b") == r"a\udce9b"


def test_long_texts_are_cut_in_the_middle_and_say_how_long_they_are() -> None:
    shown = printable("a" * 100_000 + "z" * 100_000, 100)
    assert len(shown) < 130 and shown.startswith("aaa") and shown.endswith("zzz") and "(200,000 characters)" in shown


def test_messages_and_results_obey_no_escape(capsys: pytest.CaptureFixture[str]) -> None:
    log(HOSTILE)
    with plain_output():
        print(HOSTILE)
        sys.stdout.writelines([HOSTILE])
    ran = capsys.readouterr()
    assert not {"\x1b", "\x07", "\x9b", "\r", "\u202e"} & set(ran.out + ran.err)


def test_a_message_of_200_kb_is_one_short_line(capsys: pytest.CaptureFixture[str]) -> None:
    from beambox import BeamboxError

    def command() -> None:
        raise BeamboxError(f'unknown class "{LONG}"{did_you_mean(LONG, ["Car", LONG[1:]])}')

    start = time.process_time()
    with pytest.raises(SystemExit):
        guard(command)()
    assert time.process_time() - start < 1
    err = capsys.readouterr().err
    assert len(err) < LONGEST_LINE + 50 and err.count("\n") == 1 and "characters)" in err


@pytest.mark.parametrize("encoding", ["cp1252", "ascii", "cp437", "utf-8", None, "no such"])
def test_consoles_without_a_letter_show_something_else(encoding: str | None) -> None:
    shown = plain("[ ▁▂▃▄▅▆▇█] 車 \udce9", encoding)
    shown.encode(encoding if encoding in ("cp1252", "cp437", "utf-8") else "utf-8" if encoding is None else "ascii")
    if encoding in ("cp1252", "ascii"):
        assert shown == r"[ _.:-=+*#] \u8eca \udce9"


def page(name: str, title: str = "") -> str:
    box = np.array([[10.0, 2, -0.9, 4, 1.8, 1.5, 0.5]])
    return viewer_html(Frame(street(), name), Detections(box, [0.7], [0], [name]), Labels(box, [name]), title=title)


@pytest.mark.parametrize(
    "name",
    ["{{DATA}}<img src=x onerror=alert(1)>", "{{TITLE}}</script><script>alert(1)</script>", "<!--<script>", LONG,
     "\\u003c/script>", "\udce9", "&amp;\"'"],
)  # fmt: skip
def test_pages_hold_names_as_text_only(name: str) -> None:
    """The title was put in first, and what it held was then replaced by data: a mark in a name broke out of its tag."""
    text, plain_text = page(name), page("car")
    for mark in ("<script", "</script", "<!--", "<img", "<title", "</title", "<"):
        assert text.count(mark) == plain_text.count(mark), mark
    data = text[text.index('type="application/json">') + 24 :].partition("</script>")[0]
    assert json.loads(data)["classes"][0]["name"] == name


@pytest.mark.parametrize("name", ["two\nlines", "\x1b[31m", LONG, "\udce9", "\u202e", "", " ", "\x00"])
def test_pictures_of_any_name_are_drawn(name: str, tmp_path: Path) -> None:
    box = np.array([[10.0, 2, -0.9, 4, 1.8, 1.5, 0.5]])
    frame = Frame(street(), name, Labels(box, [name]))
    start = time.process_time()
    assert frame.plot(Detections(box, [0.7], [0], [name])).size[0] > 400 and frame.plot().size[0] > 400
    assert time.process_time() - start < 10
    assert frame._repr_html_() and frame.labels is not None and frame.labels._repr_html_()


@pytest.mark.skipif(os.name == "nt" or sys.platform == "darwin", reason="file names are text on this system")
def test_files_whose_names_are_not_utf8_are_detected_in(tmp_path: Path) -> None:
    """The result was written, and then a traceback followed: the name could not be printed."""
    weights = tiny_weights(tmp_path)
    scan = os.fsencode(tmp_path) + b"/caf\xe9.bin"
    Path(os.fsdecode(scan)).write_bytes(street().tobytes())
    words = ["detect", scan, "--model", weights, "--out", tmp_path / "out", "--format", "json,csv"]
    ran = subprocess.run(
        [sys.executable, "-m", "beambox", *words], capture_output=True, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONIOENCODING": "utf-8:strict"},
    )  # fmt: skip
    assert ran.returncode == 0 and rb"caf\udce9: " in ran.stdout, ran.stderr.decode()
    (written,) = Path(tmp_path / "out").glob("*.json")
    assert json.loads(written.read_text())["frame"] == "caf\udce9"
    for name in ("p.png", "p.html"):
        words = ["show", scan, "--model", weights, "--out", tmp_path / name]
        assert subprocess.run(
            [sys.executable, "-m", "beambox", *words], capture_output=True, check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        ).returncode == 0  # fmt: skip


def test_doctor_answers_on_a_console_of_windows(tmp_path: Path) -> None:
    street().tofile(tmp_path / "scan.bin")
    ran = subprocess.run(
        [sys.executable, "-m", "beambox", "doctor", tmp_path / "scan.bin", "--model", tiny_weights(tmp_path)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONIOENCODING": "cp1252:strict"},
        capture_output=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0 and b"intensity" in ran.stdout, ran.stderr.decode()


def test_doctor_gives_a_detector_its_own_corrections_back(tmp_path: Path) -> None:
    from beambox.cli.doctor import try_out
    from beambox.infer.doctor import Diagnosis, Finding
    from beambox.infer.predictor import load
    from beambox.infer.sensor_alignment import SensorAlignment

    street().tofile(tmp_path / "scan.bin")
    detector = load(tiny_weights(tmp_path), device="cpu", sensor_height=2.5, intensity_scale=0.5)
    before = detector.alignment
    assert before != SensorAlignment()
    finding = Finding("height", "bad", "", ("--sensor-height", "1"))
    try_out(tmp_path / "scan.bin", detector, Diagnosis((finding,), SensorAlignment(z_offset=1.0), 0.1))
    assert detector.alignment == before and detector.intensity_scale == 0.5


def test_hostile_class_names_of_results_reach_no_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    street().tofile(tmp_path / "scan.bin")
    (tmp_path / "results").mkdir()
    for name in (HOSTILE, LONG):
        found = Detections(np.array([[10.0, 2, -0.9, 4, 1.8, 1.5, 0.5]]), [0.7], [0], [name], "scan")
        text = found.to_json().replace('"name"', '"nam"')
        (tmp_path / "results" / "scan.json").write_text(text)
        ran = beambox(
            capsys, "show", tmp_path / "scan.bin", "--results", tmp_path / "results", "--out", tmp_path / "p.png"
        )
        assert ran.status == 2 and len(ran.err) < 3000 and not {"\x1b", "\x07"} & set(ran.err)
        (tmp_path / "results" / "scan.json").write_text(found.to_json())
        ran = beambox(
            capsys, "show", tmp_path / "scan.bin", "--results", tmp_path / "results", "--out", tmp_path / "p.png"
        )
        assert ran.status == 0, ran.err


def test_a_stream_without_an_encoding_is_written_to() -> None:
    target = io.StringIO()
    before, sys.stdout = sys.stdout, target
    try:
        with plain_output():
            print("▁ ok")
    finally:
        sys.stdout = before
    assert target.getvalue() == "▁ ok\n"
