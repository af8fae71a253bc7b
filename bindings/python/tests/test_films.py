"""`endless record --film`: compares films, read by another decoder, with the frames of an environment."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import endless_gym
from endless_gym.program import program
from endless_gym.specs import spec

SIDE, GAP = 84, 2


def episode(id: str, seed: int, max_steps: int) -> Iterator[NDArray[np.uint8]]:
    """The pictures of an expert's episode: the observation, a gap, and the ground-truth view."""
    features = endless_gym.make_vec(id, 1, observation="features")
    frames = endless_gym.make_vec(id, 1)
    expert = endless_gym.Experts(id, 1)
    seen, _ = features.reset(seed=seed)
    observation, _ = frames.reset(seed=seed)
    try:
        for step in range(max_steps + 1):
            picture = np.full((SIDE, 2 * SIDE + GAP, 3), 24, np.uint8)
            picture[:, :SIDE] = np.asarray(observation[0]).swapaxes(0, 1)
            picture[:, SIDE + GAP :] = frames.ground_truth_view(0)[::4, ::4]
            yield picture
            if step == max_steps:
                return
            action = expert.act(seen, np.array([step == 0]))
            seen, _, terminated, truncated, _ = features.step(action)
            observation, *_ = frames.step(action)
            max_steps = min(max_steps, step + 1) if terminated[0] or truncated[0] else max_steps
    finally:
        features.close()
        frames.close()


@pytest.mark.parametrize(
    ("id", "steps", "suffix"),
    [
        ("MortarMayhem-Grid-v0", 40, "webp"),
        ("SearingSpotlights-v0", 25, "webp"),
        ("MysteryPath-v0", 25, "webp"),
        ("SearingSpotlights-v0", 25, "png"),
    ],
)
def test_films_contain_every_pixel(id: str, steps: int, suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"film.{suffix}"
    command = [*program(), "record", id, "--film", str(file), "--seed", "3", "--scale", "1"]
    subprocess.run([*command, "--max-steps", str(steps)], check=True, timeout=200)
    pictures = list(episode(id, 3, steps))
    assert len(pictures) > 5
    with Image.open(file) as film:
        assert film.n_frames == len(pictures)
        assert film.info["loop"] == 0
        duration = 0.0
        for place, picture in enumerate(pictures):
            film.seek(place)
            film.load()
            assert np.array_equal(np.asarray(film.convert("RGB")), picture), place
            duration += film.info["duration"]
    # The last picture is shown for an extra second.
    assert duration == pytest.approx(1000 * (len(pictures) / spec(id).render_fps + 1), abs=1)
