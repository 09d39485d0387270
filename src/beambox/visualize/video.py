"""Pictures of a sequence as a film: .gif and .webp by Pillow, .mp4 by ffmpeg where there is one."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from PIL import Image

from beambox.checks import BeamboxError
from beambox.io import replacing

__all__ = ["ENDINGS", "can_write", "write_video"]

ENDINGS = (".gif", ".webp", ".mp4")
LARGEST = 1280
"""Pixels of a picture's longer edge; films of full pictures are hard to send."""


def can_write(path: Path) -> None:
    """Check before any picture is drawn that a film of this name can be written.

    Raises:
        BeamboxError: for another ending, or for .mp4 without ffmpeg.
    """
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise BeamboxError(f"a film is written as {', '.join(ENDINGS)}, got the name {path}")
    if ending == ".mp4" and shutil.which("ffmpeg") is None:
        raise BeamboxError(f"{path} needs the program ffmpeg, which is not on this machine; write a .webp or .gif")


def write_video(path: Path, pictures: Iterable[Image.Image], rate: float = 10.0) -> int:
    """Write pictures as a film, whole or not at all.

    Args:
        path: .gif, .webp or .mp4.
        pictures: of any sizes; each is brought to the size of the first. They are held one at a time.
        rate: pictures per second.

    Returns:
        Number of pictures.

    Raises:
        BeamboxError: if there is no picture, or the film cannot be written.
    """
    can_write(path)
    if not 0 < rate <= 100:
        raise BeamboxError(f"a film has more than 0 and at most 100 pictures per second, got {rate:g}")
    shown = _Counted(_same_size(pictures))
    first = next(iter(shown), None)
    if first is None:
        raise BeamboxError(f"{path} cannot be written: there is no picture")
    with replacing(path) as stream:
        if path.suffix.lower() == ".mp4":
            stream.write(_mp4(first, shown, rate))
        elif path.suffix.lower() == ".webp":
            first.save(
                stream,
                format="WEBP",
                save_all=True,
                append_images=shown,
                duration=round(1000 / rate),
                loop=0,
                quality=80,
            )
        else:
            rest = (_few_colors(picture) for picture in shown)
            few = _few_colors(first)
            few.save(stream, format="GIF", save_all=True, append_images=rest, duration=round(1000 / rate), loop=0)
    return shown.count


class _Counted:
    """An iterator that knows how many it handed out."""

    def __init__(self, items: Iterator[Image.Image]) -> None:
        self._items = items
        self.count = 0

    def __iter__(self) -> Iterator[Image.Image]:
        for item in self._items:
            self.count += 1
            yield item


def _same_size(pictures: Iterable[Image.Image]) -> Iterator[Image.Image]:
    size = None
    for picture in pictures:
        if size is None:
            shrink = min(1.0, LARGEST / max(picture.size))
            width, height = (max(2, round(edge * shrink) // 2 * 2) for edge in picture.size)  # even, as mp4 wants
            size = (width, height)
        scale = min(size[0] / picture.width, size[1] / picture.height)
        fitted = picture.convert("RGB").resize((round(picture.width * scale), round(picture.height * scale)))
        frame = Image.new("RGB", size)
        frame.paste(fitted, (0, 0))
        yield frame


def _few_colors(picture: Image.Image) -> Image.Image:
    return picture.quantize(128, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


def _mp4(first: Image.Image, rest: Iterable[Image.Image], rate: float) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "film.mp4"
        size = f"{first.width}x{first.height}"
        command = ["ffmpeg", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size]
        command += ["-r", f"{rate:g}", "-i", "-", "-pix_fmt", "yuv420p", "-crf", "20", str(out)]
        with tempfile.TemporaryFile() as errors:
            with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=errors) as process:
                assert process.stdin is not None
                try:
                    process.stdin.write(first.tobytes())
                    for picture in rest:
                        process.stdin.write(picture.tobytes())
                    process.stdin.close()
                except BrokenPipeError:
                    pass  # its own words follow
            if process.returncode or not out.is_file():
                errors.seek(0)
                words = " ".join(errors.read().decode("utf-8", "replace").split())
                raise BeamboxError(f"ffmpeg could not write the film: {words[:300] or process.returncode}")
        return out.read_bytes()
