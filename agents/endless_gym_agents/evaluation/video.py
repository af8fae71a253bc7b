"""Videos of episodes, written as `endless record --film` writes them.

A frame of a video shows the agent's observation on the left, the ground-truth view on the right, and a line of text below.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from endless_gym import _native
from endless_gym.cli import find_ffmpeg

#: A frame of a video, uint8 (HEIGHT, WIDTH, 3), indexed [row][column][channel].
Frame = NDArray[np.uint8]

#: Side of both views, gap between them and height of the line of text, in pixels.
SIDE, GAP, TEXT = 336, 8, 24
WIDTH, HEIGHT = 2 * SIDE + GAP, SIDE + TEXT
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
    draw.fontmode = "1"  # No antialiasing, which would make the file larger.
    draw.text((6, 5), text, fill=_TEXT_COLOUR, font=ImageFont.load_default())
    frame[SIDE:] = np.asarray(strip)
    return frame


def write(file: Path, frames: Iterable[Frame], fps: int) -> None:
    """Write a video. If writing is interrupted, no partial file remains, and a former file keeps its content.

    Args:
        file: Output file, with the suffix `.webp` (lossless) or `.mp4` (needs ffmpeg).
        frames: At least one frame, uint8 (HEIGHT, WIDTH, 3) each.
        fps: Frames per second, 1 or more.

    Raises:
        ValueError: There is no frame, or the frames differ in size.
        OSError: The suffix is another one, the folder cannot be written, or ffmpeg is missing or failed.
    """
    find_ffmpeg()
    _native.write_film(file, frames, fps)
