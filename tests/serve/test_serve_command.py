"""`beambox serve` on a real socket: what a file gives, slow and broken senders, and its end."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from beambox.structures import Detections
from oracles.command_line import beambox
from oracles.tiny_detector import street, tiny_weights


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[subprocess.Popen[str], int, Path]]:
    folder = tmp_path_factory.mktemp("serve")
    words = [sys.executable, "-m", "beambox", "serve", "--model", str(tiny_weights(folder)), "--port", "0"]
    words += ["--precision", "float32", "--body-seconds", "1", "--max-mb", "1"]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, cwd=folder)
    assert process.stderr is not None
    line = ""
    while not (found := re.search(r"http://127\.0\.0\.1:(\d+);", line)):
        line = process.stderr.readline()
        assert line, "the service ended"
    yield process, int(found[1]), folder
    process.kill()
    process.wait()


def post(port: int, body: bytes, query: str = "") -> tuple[int, str]:
    """Send a sweep; again where the service still works on requests whose senders have gone."""
    patience = time.monotonic() + 10
    while (answer := post_once(port, body, query))[0] == 503 and time.monotonic() < patience:
        time.sleep(0.1)
    return answer


def post_once(port: int, body: bytes, query: str) -> tuple[int, str]:
    request = urllib.request.Request(f"http://127.0.0.1:{port}/detect{query}", data=body, method="POST")
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def raw(port: int, content: bytes, wait: float = 0.0) -> bytes:
    """Send bytes as they are, and return all that comes until the other side closes or nothing comes."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(content)
        if wait < 0:
            return b""  # gone without a word
        connection.settimeout(5)
        received = b""
        try:
            while chunk := connection.recv(65536):
                received += chunk
        except TimeoutError:
            pass
        return received


def test_it_answers_what_the_command_writes_survives_broken_senders_and_ends(
    service: tuple[subprocess.Popen[str], int, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    process, port, folder = service
    street().tofile(folder / "scan.bin")
    options = ("--model", folder / "tiny.safetensors", "--precision", "float32", "--out", folder / "out")
    assert beambox(capsys, "detect", folder / "scan.bin", *options).status == 0
    status, text = post(port, street().tobytes(), "?frame=scan")
    wanted = Detections.from_json((folder / "out" / "scan.json").read_text())
    assert status == 200 and Detections.from_json(text) == wanted and len(wanted) > 5
    assert str(folder) not in text, "the weights' path is nobody's business"

    head = b"POST /detect HTTP/1.1\r\nHost: x\r\n"
    slow = raw(port, head + b"Content-Length: 1000\r\n\r\nabc")  # and nothing more
    assert slow.startswith(b"HTTP/1.1 408") and b"did not arrive within 1 s" in slow
    assert b"413" in raw(port, head + b"Content-Length: 99999999999\r\n\r\n").splitlines()[0]
    assert raw(port, b"\x16\x03\x01 no http\r\n\r\n").startswith(b"HTTP/1.1 400")
    assert b"400" in raw(port, head + b"Content-Length: -5\r\n\r\n").splitlines()[0]
    for _ in range(20):
        raw(port, head + b"Content-Length: 1000\r\n\r\nabc", wait=-1)
    assert post(port, b"text, not numbers at all")[0] == 400
    status, again = post(port, street().tobytes(), "?frame=scan")
    assert (status, again) == (200, text)

    if os.name == "nt":
        return
    process.send_signal(signal.SIGTERM)
    started = time.monotonic()
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 0 and "stopped" in errors and time.monotonic() - started < 20
    assert "Traceback" not in errors, errors


def test_a_taken_port_is_told_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        ran = beambox(capsys, "serve", "--port", taken.getsockname()[1])
    assert ran.status == 2 and "cannot listen at 127.0.0.1 port" in ran.err and ran.err.count("\n") == 1
