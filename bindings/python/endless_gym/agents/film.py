"""Films of episodes: GIF by Pillow, MP4 by ffmpeg.

A picture has the agent's observation on the left, what the original shows a person on the right, and a line of text below.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Picture = NDArray[np.uint8]

#: Side of both views, the gap between them and the height of the line of text, in pixels.
SIDE, GAP, TEXT = 336, 8, 24
WIDTH, HEIGHT = 2 * SIDE + GAP, SIDE + TEXT
SUFFIXES = (".gif", ".mp4")
_BACKGROUND, _INK = 24, (230, 230, 230)


def compose(frame: Picture, view: Picture, text: str) -> Picture:
    """One picture of a film, uint8 (HEIGHT, WIDTH, 3).

    Args:
        frame: The observation, uint8 (84, 84, 3), indexed [x][y][channel].
        view: The ground-truth view, uint8 (336, 336, 3), indexed [row][column][channel].
        text: One line.
    """
    picture = np.full((HEIGHT, WIDTH, 3), _BACKGROUND, dtype=np.uint8)
    times = SIDE // frame.shape[0]
    picture[:SIDE, :SIDE] = frame.swapaxes(0, 1).repeat(times, 0).repeat(times, 1)
    picture[:SIDE, SIDE + GAP :] = view
    strip = Image.new("RGB", (WIDTH, TEXT), (_BACKGROUND,) * 3)
    ink = ImageDraw.Draw(strip)
    ink.fontmode = "1"  # Without smoothing, a GIF's 256 colours are enough.
    ink.text((6, 5), text, fill=_INK, font=ImageFont.load_default())
    picture[SIDE:] = np.asarray(strip)
    return picture


def check(file: Path) -> None:
    """See that `write` will be able to.

    Raises:
        ValueError: It is neither a GIF nor an MP4, or ffmpeg is missing.
        FileNotFoundError: There is no such folder.
    """
    if file.suffix.lower() not in SUFFIXES:
        raise ValueError(f"films are {' or '.join(SUFFIXES)}, not `{file.name}`; change --out")
    if not file.resolve().parent.is_dir():
        raise FileNotFoundError(f"no folder {file.parent} to write {file.name} to; make it first")
    if file.suffix.lower() == ".mp4":
        _ffmpeg()


def write(file: Path, pictures: Iterable[Picture], fps: int) -> None:
    """Write a film; nothing is left of one that is interrupted.

    Args:
        file: Its name, with `.gif` or `.mp4`.
        pictures: uint8 (HEIGHT, WIDTH, 3) each; one or more.
        fps: Pictures in a second.
    """
    check(file)
    partial = file.with_name(f".{file.name}.partial{file.suffix.lower()}")
    try:
        (_gif if file.suffix.lower() == ".gif" else _mp4)(partial, iter(pictures), fps)
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def _gif(file: Path, pictures: Iterator[Picture], fps: int) -> None:
    images = (Image.fromarray(picture).convert("P", palette=Image.Palette.ADAPTIVE) for picture in pictures)
    next(images).save(file, save_all=True, append_images=images, duration=round(1000 / fps), loop=0)


def _mp4(file: Path, pictures: Iterator[Picture], fps: int) -> None:
    first = next(pictures)
    height, width, _ = first.shape
    arguments = [
        _ffmpeg(),
        "-y",
        "-loglevel",
        "error",
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-s",
        f"{width}x{height}",
    ]
    arguments += ["-r", str(fps), "-i", "-", "-pix_fmt", "yuv420p", str(file)]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        try:
            for picture in chain([first], pictures):
                process.stdin.write(picture.tobytes())
            _, errors = process.communicate()
        except BrokenPipeError:
            _, errors = process.communicate()
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        raise OSError(f"ffmpeg could not write {file.name}: {errors.decode(errors='replace').strip()}")


def _ffmpeg() -> str:
    """The program's path: of the system, or of the package imageio-ffmpeg."""
    found = shutil.which("ffmpeg")
    if found:
        return found
    try:
        import imageio_ffmpeg
    except ImportError:
        raise ValueError(
            "MP4 needs ffmpeg, which is not installed: pip install imageio-ffmpeg, or write a .gif"
        ) from None
    program: str = imageio_ffmpeg.get_ffmpeg_exe()
    return program
