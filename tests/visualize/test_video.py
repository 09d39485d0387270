"""Films: every picture in order, one size, whole or not at all."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from PIL import Image

from beambox.checks import BeamboxError
from beambox.visualize.video import write_video

PICTURES = [Image.new("RGB", (101 + 20 * k, 60), (60 * k, 255 - 60 * k, 30)) for k in range(4)]


@pytest.mark.parametrize("ending", ["gif", "webp"])
def test_pillow_writes_every_picture_in_order_and_in_one_size(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"film.{ending}"
    assert write_video(path, iter(PICTURES), rate=5) == 4
    film = Image.open(path)
    assert film.n_frames == 4 and film.size == (100, 60)  # type: ignore[attr-defined]
    seconds = 0
    for k in range(4):
        film.seek(k)
        film.load()
        red, green, _ = film.convert("RGB").getpixel((5, 5))  # type: ignore[misc]
        assert abs(red - 60 * k) < 12 and abs(green - 255 + 60 * k) < 12
        seconds += film.info["duration"]
    assert seconds == 4 * 200


def test_large_pictures_are_shrunk(tmp_path: Path) -> None:
    write_video(tmp_path / "film.gif", [Image.new("RGB", (3000, 1501))])
    assert Image.open(tmp_path / "film.gif").size == (1280, 640)


def test_what_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    def broken():
        yield PICTURES[0]
        raise BeamboxError("a sweep cannot be read")

    for name, pictures, message in (
        ("film.gif", broken(), "a sweep cannot be read"),
        ("film.webp", broken(), "a sweep cannot be read"),
        ("film.gif", iter(()), "there is no picture"),
        ("film.avi", iter(PICTURES), "a film is written as"),
    ):
        with pytest.raises(BeamboxError, match=message):
            write_video(tmp_path / name, pictures)
    with pytest.raises(BeamboxError, match="pictures per second"):
        write_video(tmp_path / "film.gif", PICTURES, rate=0)
    assert list(tmp_path.iterdir()) == []


def test_mp4_needs_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("beambox.visualize.video.shutil.which", lambda _: None)
    with pytest.raises(BeamboxError, match=r"needs the program ffmpeg.*write a \.webp or \.gif"):
        write_video(tmp_path / "film.mp4", PICTURES)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg to write .mp4")
def test_ffmpeg_writes_a_film(tmp_path: Path) -> None:
    assert write_video(tmp_path / "film.mp4", PICTURES) == 4
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"
