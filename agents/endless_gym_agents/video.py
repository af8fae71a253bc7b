"""Videos of episodes: GIF and WebP with Pillow, MP4 with ffmpeg.

A frame of a video shows the agent's observation on the left, the ground-truth view on the right, and a line of text below.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from endless_gym_agents import atomic

#: A frame of a video, uint8 (HEIGHT, WIDTH, 3), indexed [row][column][channel].
Frame = NDArray[np.uint8]

#: Side of both views, gap between them and height of the line of text, in pixels.
SIDE, GAP, TEXT = 336, 8, 24
WIDTH, HEIGHT = 2 * SIDE + GAP, SIDE + TEXT
#: Supported file name suffixes.
SUFFIXES = (".gif", ".webp", ".mp4")
_BACKGROUND, _TEXT_COLOUR = 24, (230, 230, 230)


def compose(picture: NDArray[np.uint8], view: NDArray[np.uint8], text: str) -> Frame:
    """Compose a frame of a video.

    Args:
        picture: The environment's frame, uint8 (84, 84, 3), indexed [row][column][channel].
        view: The ground-truth view, uint8 (336, 336, 3), indexed [row][column][channel].
        text: One line of text.

    Returns:
        uint8 (HEIGHT, WIDTH, 3).
    """
    frame = np.full((HEIGHT, WIDTH, 3), _BACKGROUND, dtype=np.uint8)
    scale = SIDE // picture.shape[0]
    frame[:SIDE, :SIDE] = picture.repeat(scale, 0).repeat(scale, 1)
    frame[:SIDE, SIDE + GAP :] = view
    strip = Image.new("RGB", (WIDTH, TEXT), (_BACKGROUND,) * 3)
    draw = ImageDraw.Draw(strip)
    draw.fontmode = "1"  # No antialiasing, which would need more than the 256 colours of a GIF.
    draw.text((6, 5), text, fill=_TEXT_COLOUR, font=ImageFont.load_default())
    frame[SIDE:] = np.asarray(strip)
    return frame


def check(file: Path) -> None:
    """Check that `write` can write this file.

    Raises:
        ValueError: The suffix is not supported, or ffmpeg is not installed.
        FileNotFoundError: The folder does not exist.
    """
    if file.suffix.lower() not in SUFFIXES:
        raise ValueError(f"--out must end in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}, got `{file.name}`")
    if not file.resolve().parent.is_dir():
        raise FileNotFoundError(f"cannot write {file}: no folder {file.parent}")
    if file.suffix.lower() == ".mp4":
        _ffmpeg()


def write(file: Path, frames: Iterable[Frame], fps: int) -> None:
    """Write a video. If writing is interrupted, no partial file remains, and a former file keeps its content.

    Args:
        file: Output file, with the suffix `.gif`, `.webp` (lossless) or `.mp4`.
        frames: At least one frame, uint8 (HEIGHT, WIDTH, 3) each.
        fps: Frames per second.

    Raises:
        ValueError: As for `check`.
        FileNotFoundError: As for `check`.
        OSError: ffmpeg failed; the message contains its error.
    """
    check(file)
    suffix, images = file.suffix.lower(), map(Image.fromarray, frames)
    with atomic.replacing(file) as new:
        if suffix == ".gif":
            reduced = (image.convert("P", palette=Image.Palette.ADAPTIVE) for image in images)
            _animation(new, reduced, fps, format="GIF")
        elif suffix == ".webp":
            _animation(new, images, fps, format="WEBP", lossless=True)
        else:
            _mp4(new, iter(frames), fps)


def _animation(file: Path, images: Iterator[Image.Image], fps: int, **options: Any) -> None:
    next(images).save(file, save_all=True, append_images=images, duration=round(1000 / fps), loop=0, **options)


def _mp4(file: Path, frames: Iterator[Frame], fps: int) -> None:
    first = next(frames)
    height, width, _ = first.shape
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
    arguments = [_ffmpeg(), "-y", "-loglevel", "error", *source, "-pix_fmt", "yuv420p", "-f", "mp4", str(file)]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        try:
            for frame in chain([first], frames):
                process.stdin.write(frame.tobytes())
            _, errors = process.communicate()
        except BrokenPipeError:
            _, errors = process.communicate()
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        raise OSError(f"ffmpeg failed to write {file.name}: {errors.decode(errors='replace').strip()}")


def _ffmpeg() -> str:
    """Path of ffmpeg: the system's, or that of the package imageio-ffmpeg."""
    found = shutil.which("ffmpeg")
    if found:
        return found
    try:
        import imageio_ffmpeg
    except ImportError:
        raise ValueError(
            "an .mp4 needs ffmpeg, which is not installed: pip install imageio-ffmpeg, or use .webp"
        ) from None
    program: str = imageio_ffmpeg.get_ffmpeg_exe()
    return program
