"""Animations of the environments, played by the scripted experts."""

from __future__ import annotations

import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageSequence

from endless_gym.program import program
from endless_gym.specs import all_specs

#: An image or a film, uint8 (frames, height, width, 3) or without the first axis.
Pixels = NDArray[np.uint8]

SCREEN = 84
_FONTS = Path(matplotlib.get_data_path()) / "fonts/ttf"

#: Colours of the panel behind the frames and of its text.
PANEL, TEXT = (18, 22, 32), (214, 220, 232)


class Film(NamedTuple):
    """Frames of an expert's episode, uint8 (frames, 84, 84, 3), indexed [frame][row][column][channel]."""

    observation: Pixels
    ground_truth: Pixels


@dataclass(frozen=True)
class Scene:
    """How an environment is shown.

    Attributes:
        id: Environment id.
        seed: Seed of the episode in its own animation.
        step: Milliseconds that each step is shown in its own animation.
        steps: Number of steps after which its own animation ends.
        overview_seed: Seed of the episode in the overview.
        hold: Number of frames that each step is shown in the overview.
        options: Reset parameters of the episode in the overview, for short episodes and readable commands.
    """

    id: str
    seed: int
    step: int
    steps: int
    overview_seed: int
    hold: int
    options: tuple[str, ...] = ()


_SHOWN = ("command_show_duration=[6]", "command_show_delay=[2]")

SCENES = [
    Scene("MortarMayhem-v0", 1, 60, 400, 4, 1, ("command_count=[6]", *_SHOWN)),
    Scene("MortarMayhem-Grid-v0", 1, 120, 400, 1, 2, ("command_count=[8]",)),
    Scene("MortarMayhemB-v0", 1, 60, 400, 2, 1, ("command_count=[8]",)),
    Scene("MortarMayhemB-Grid-v0", 1, 160, 400, 2, 2, ("command_count=[12]",)),
    Scene("Endless-MortarMayhem-v0", 1, 60, 340, 1, 1, _SHOWN),
    Scene("MysteryPath-v0", 11, 40, 400, 10, 1),
    Scene("MysteryPath-Grid-v0", 8, 160, 400, 11, 3),
    Scene("Endless-MysteryPath-v0", 1, 40, 500, 1, 1),
    Scene("SearingSpotlights-v0", 15, 80, 400, 13, 1, ("num_coins=[4]",)),
    Scene("Endless-SearingSpotlights-v0", 1, 40, 500, 3, 1),
]

#: The overview: cells per row, scale, gap and label height in pixels, number of frames, and milliseconds per frame.
COLUMNS, SCALE, GAP, LABEL = 5, 4, 24, 48
LENGTH, FRAME_MS = 196, 80
#: Brightness of the last frames, so that the film loops without a jump.
_FADE = (0.7, 0.4, 0.15)


def film(id: str, seed: int, steps: int, options: tuple[str, ...] = ()) -> Film:
    """Play an episode, at most `steps` steps."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "film.webp"
        command = [*program(), "record", id, f"--film={file}", f"--seed={seed}", f"--max-steps={steps}", "--scale=1"]
        command += [f"--option={given}" for given in options]
        subprocess.check_call(command, stdout=subprocess.DEVNULL)
        with Image.open(file) as pictures:
            both = np.stack([np.asarray(each.convert("RGB")) for each in ImageSequence.Iterator(pictures)])
    return Film(both[:, :, :SCREEN], both[:, :, -SCREEN:])


def magnify(pixels: Pixels, scale: int) -> Pixels:
    """Repeat each pixel of an image."""
    return pixels.repeat(scale, 0).repeat(scale, 1)


def label(panel: Image.Image, centre: int, top: int, text: str, size: int) -> None:
    """Write text below a frame."""
    font = ImageFont.truetype(_FONTS / "DejaVuSans.ttf", size, layout_engine=ImageFont.Layout.BASIC)
    ImageDraw.Draw(panel).text((centre, top), text, fill=TEXT, font=font, anchor="mt")


def write(file: Path, frames: list[Image.Image], milliseconds: int) -> None:
    """Write an animation that repeats forever."""
    first, *others = frames
    settings = {"lossless": True, "quality": 100, "method": 4, "minimize_size": True}
    first.save(file, save_all=True, append_images=others, duration=milliseconds, loop=0, **settings)


def overview(file: Path) -> None:
    """All environments in a grid."""
    ids = [id for id, spec in all_specs().items() if spec.frame]
    if {scene.id for scene in SCENES} != set(ids):
        raise ValueError(f"SCENES must have one scene for each of {', '.join(ids)}")
    rows = -(-len(SCENES) // COLUMNS)
    side = SCREEN * SCALE
    size = COLUMNS * (side + GAP) + GAP, rows * (side + LABEL + GAP) + GAP
    panel, places, films = Image.new("RGB", size, PANEL), [], []
    for number, scene in enumerate(SCENES):
        x, y = GAP + number % COLUMNS * (side + GAP), GAP + number // COLUMNS * (side + LABEL + GAP)
        label(panel, x + side // 2, y + side + 16, scene.id.removesuffix("-v0"), 25)
        places.append((x, y))
        played = film(scene.id, scene.overview_seed, LENGTH, scene.options).ground_truth.repeat(scene.hold, 0)
        films.append(played)
    frames = []
    for number in range(LENGTH):
        picture = panel.copy()
        light = _FADE[number - LENGTH] if number >= LENGTH - len(_FADE) else 1.0
        for place, played in zip(places, films, strict=True):
            frame = played[min(number, len(played) - 1)]
            picture.paste(Image.fromarray(magnify((frame * light).astype(np.uint8), SCALE)), place)
        frames.append(picture)
    write(file, frames, FRAME_MS)


def environment(file: Path, scene: Scene) -> None:
    """One environment: the observation next to the ground-truth view."""
    scale, gap, caption = 3, 12, 30
    side = SCREEN * scale
    panel = Image.new("RGB", (2 * side + 3 * gap, side + gap + caption), PANEL)
    for place, text in enumerate(("observation", "ground truth")):
        label(panel, gap + place * (side + gap) + side // 2, side + gap + 9, text, 13)
    frames = []
    for pair in zip(*film(scene.id, scene.seed, scene.steps), strict=True):
        picture = panel.copy()
        for place, frame in enumerate(pair):
            picture.paste(Image.fromarray(magnify(frame, scale)), (gap + place * (side + gap), gap))
        frames.append(picture)
    write(file, [*frames, *[frames[-1]] * (1000 // scene.step)], scene.step)
