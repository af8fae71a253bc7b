"""Each wrapper of Gymnasium, with the arguments for its test or the reason why it is not tested."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as vectors
from support import MEMORY_GYM

import endless_gym

try:
    import torch
except ImportError:
    torch = None  # the tests that need it are marked

#: Reset parameters with which episodes end within a few steps.
SHORT: dict[str, dict[str, Any]] = {
    id: {"command_count": [1], "explosion_duration": [1], "explosion_delay": [2]}
    if id.startswith("MortarMayhem")
    else {"max_steps": 4}
    for id in MEMORY_GYM
}
for id in ("MortarMayhem-v0", "MortarMayhem-Grid-v0"):
    SHORT[id] |= {"command_show_duration": [1], "command_show_delay": [0]}

Wrap = Callable[..., Any]


class Case(NamedTuple):
    """A wrapper that applies."""

    wrap: Wrap
    #: Arguments of the environments besides the id and the options.
    kwargs: Mapping[str, Any] = MappingProxyType({})
    #: Whether the wrapper works with dict observations (true), with others (false), or both.
    dicts: tuple[bool, ...] = (False, True)
    #: The auto-reset modes with which a vector wrapper works.
    modes: tuple[AutoresetMode, ...] = tuple(AutoresetMode)


class Refuses(NamedTuple):
    """A wrapper that itself refuses these environments."""

    wrap: Wrap
    error: type[Exception]
    match: str


RGB = {"render_mode": "rgb_array"}
#: Gymnasium's observation wrappers do not change `final_obs`, and its converters do not accept object arrays.
NOT_SAME_STEP = (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED)
NOT_JAX = "it is for environments that return JAX arrays"
FRAMES = (False,)


def unchanged(given: Any) -> Any:
    return given


def doubled(reward: Any) -> Any:
    """Modifies the rewards in place."""
    reward *= 2
    return reward


def scaled(env: Any, wrapper: Wrap, *args: Any) -> Any:
    """`wrapper` over frames converted to float32."""
    dtype = (
        vectors.DtypeObservation if isinstance(env, gymnasium.vector.VectorEnv) else gymnasium.wrappers.DtypeObservation
    )
    return wrapper(dtype(env, np.float32), *args)


def needs_box_actions(wrapper: Wrap, **kwargs: Any) -> Refuses:
    return Refuses(
        lambda env: wrapper(env, **kwargs), (AssertionError, TypeError), "Box|action_space|Continuous|Discrete"
    )


w = gymnasium.wrappers
SINGLE: dict[str, Case | Refuses | str] = {
    "AtariPreprocessing": "it is for environments of the Arcade Learning Environment",
    "DelayObservation": Case(lambda env: w.DelayObservation(env, 2), dicts=FRAMES),
    "DtypeObservation": Case(lambda env: w.DtypeObservation(env, np.float32), dicts=FRAMES),
    "DiscretizeObservation": Case(
        lambda env: w.DiscretizeObservation(
            w.TransformObservation(env, lambda frame: frame[:4, :4], gymnasium.spaces.Box(0, 255, (4, 4), np.uint8)),
            bins=4,
            multidiscrete=True,
        ),
        {"frames": endless_gym.Frames(grayscale=True)},
        FRAMES,
    ),
    "FilterObservation": Case(lambda env: w.FilterObservation(env, ["visual_observation"]), dicts=(True,)),
    "FlattenObservation": Case(w.FlattenObservation),
    "FrameStackObservation": Case(lambda env: w.FrameStackObservation(env, 3)),
    "GrayscaleObservation": Case(w.GrayscaleObservation, dicts=FRAMES),
    "TransformObservation": Case(lambda env: w.TransformObservation(env, unchanged, None)),
    "MaxAndSkipObservation": Case(lambda env: w.MaxAndSkipObservation(env, skip=2), dicts=FRAMES),
    "NormalizeObservation": Case(w.NormalizeObservation, dicts=FRAMES),
    "AddRenderObservation": Case(lambda env: w.AddRenderObservation(env, render_only=False), RGB),
    "ResizeObservation": Case(lambda env: w.ResizeObservation(env, (42, 42)), dicts=FRAMES),
    "ReshapeObservation": Case(lambda env: w.ReshapeObservation(env, (84 * 84, 3)), dicts=FRAMES),
    "RescaleObservation": Case(
        lambda env: scaled(env, w.RescaleObservation, np.float32(-1), np.float32(1)), dicts=FRAMES
    ),
    "TimeAwareObservation": Case(lambda env: w.TimeAwareObservation(w.TimeLimit(env, 5), flatten=False)),
    "ClipAction": needs_box_actions(w.ClipAction),
    "DiscretizeAction": needs_box_actions(w.DiscretizeAction, bins=3),
    "TransformAction": Case(lambda env: w.TransformAction(env, unchanged, None)),
    "RescaleAction": needs_box_actions(w.RescaleAction, min_action=np.float32(0), max_action=np.float32(1)),
    "StickyAction": Case(lambda env: w.StickyAction(env, 0.5)),
    "RepeatAction": Case(lambda env: w.RepeatAction(env, 2)),
    "ClipReward": Case(lambda env: w.ClipReward(env, -0.1, 0.1)),
    "TransformReward": Case(lambda env: w.TransformReward(env, lambda reward: 2 * reward)),
    "NormalizeReward": Case(w.NormalizeReward),
    "TimeLimit": Case(lambda env: w.TimeLimit(env, 3)),
    "Autoreset": Case(w.Autoreset),
    "PassiveEnvChecker": Case(w.PassiveEnvChecker),
    "OrderEnforcing": Case(w.OrderEnforcing),
    "RecordEpisodeStatistics": Case(w.RecordEpisodeStatistics),
    "AddWhiteNoise": Case(lambda env: w.AddWhiteNoise(env, 0.5), RGB),
    "ObstructView": Case(lambda env: w.ObstructView(env, 0.2, 4), {"render_mode": "debug_rgb_array"}),
    "RenderCollection": Case(w.RenderCollection, RGB),
    "RecordVideo": Case(lambda env: w.RecordVideo(env, "videos", gc_trigger=None), RGB),
    "HumanRendering": Case(w.HumanRendering, {**RGB, "view": "ground_truth"}),
    "ArrayConversion": Case(lambda env: w.ArrayConversion(env, env_xp=np, target_xp=torch)),
    "JaxToNumpy": NOT_JAX,
    "JaxToTorch": NOT_JAX,
    "NumpyToTorch": Case(lambda env: w.NumpyToTorch(env)),
}

v = vectors
VECTOR: dict[str, Case | Refuses | str] = {
    "VectorizeTransformObservation": Case(
        lambda env: v.VectorizeTransformObservation(env, w.ResizeObservation, shape=(42, 42)),
        dicts=FRAMES,
        modes=NOT_SAME_STEP,
    ),
    "VectorizeTransformAction": Case(
        lambda env: v.VectorizeTransformAction(env, w.TransformAction, func=unchanged, action_space=None)
    ),
    "VectorizeTransformReward": Case(
        lambda env: v.VectorizeTransformReward(env, w.TransformReward, func=lambda reward: 2 * reward)
    ),
    "DictInfoToList": Case(v.DictInfoToList),
    "TransformObservation": Case(lambda env: v.TransformObservation(env, unchanged), modes=NOT_SAME_STEP),
    "FilterObservation": Case(
        lambda env: v.FilterObservation(env, ["visual_observation"]), dicts=(True,), modes=NOT_SAME_STEP
    ),
    "FlattenObservation": Case(v.FlattenObservation, modes=NOT_SAME_STEP),
    "GrayscaleObservation": Case(v.GrayscaleObservation, dicts=FRAMES, modes=NOT_SAME_STEP),
    "ResizeObservation": Case(lambda env: v.ResizeObservation(env, (42, 42)), dicts=FRAMES, modes=NOT_SAME_STEP),
    "ReshapeObservation": Case(lambda env: v.ReshapeObservation(env, (84 * 84, 3)), dicts=FRAMES, modes=NOT_SAME_STEP),
    "RescaleObservation": Case(
        lambda env: scaled(env, v.RescaleObservation, np.float32(-1), np.float32(1)), dicts=FRAMES, modes=NOT_SAME_STEP
    ),
    "DtypeObservation": Case(lambda env: v.DtypeObservation(env, np.float32), dicts=FRAMES, modes=NOT_SAME_STEP),
    "NormalizeObservation": Case(v.NormalizeObservation, dicts=FRAMES, modes=(AutoresetMode.NEXT_STEP,)),
    "TransformAction": Case(lambda env: v.TransformAction(env, unchanged)),
    "ClipAction": needs_box_actions(v.ClipAction),
    "RescaleAction": needs_box_actions(v.RescaleAction, min_action=0.0, max_action=1.0),
    "TransformReward": Case(lambda env: v.TransformReward(env, doubled)),
    "ClipReward": Case(lambda env: v.ClipReward(env, -0.1, 0.1)),
    "NormalizeReward": Case(v.NormalizeReward),
    "RecordEpisodeStatistics": Case(v.RecordEpisodeStatistics),
    "RecordVideo": Case(lambda env: v.RecordVideo(env, "videos", video_length=3, gc_trigger=None)),
    "HumanRendering": Case(v.HumanRendering),
    "ArrayConversion": Case(lambda env: v.ArrayConversion(env, env_xp=np, target_xp=torch), modes=NOT_SAME_STEP),
    "JaxToNumpy": NOT_JAX,
    "JaxToTorch": NOT_JAX,
    "NumpyToTorch": Case(lambda env: v.NumpyToTorch(env), modes=NOT_SAME_STEP),
}


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[list[np.ndarray]]]:
    """The frames of each video, instead of a file: MoviePy, which would write it, requires an older Pillow.

    Windows are not shown, and do not wait for the next picture.
    """
    videos: list[list[np.ndarray]] = []

    class ImageSequenceClip:
        def __init__(self, frames: list[np.ndarray], fps: int) -> None:
            assert fps > 0
            videos.append(list(frames))

        def write_videofile(self, path: str, logger: Any = None) -> None:
            assert Path(path).name.endswith(".mp4")

    for name in ("moviepy", "moviepy.video", "moviepy.video.io", "moviepy.video.io.ImageSequenceClip"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    sys.modules["moviepy.video.io.ImageSequenceClip"].ImageSequenceClip = ImageSequenceClip
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(pygame.time, "Clock", lambda: types.SimpleNamespace(tick=lambda fps: None))
    monkeypatch.chdir(tmp_path)
    yield videos


def plain(value: Any) -> Any:
    """A comparable copy of a value, without times and with arrays instead of tensors. It holds no batch of an engine."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items() if key != "t"}
    if isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [plain(item) for item in value]
    if torch is not None and isinstance(value, torch.Tensor):
        value = value.numpy()
    return value.copy() if isinstance(value, np.ndarray) else value
