"""Pictures: render modes of vector environments, windows, and play with the keyboard."""

import os
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.utils.play import play
from support import MEMORY_GYM, WHERE, same
from wrappers import SHORT, recorded

import endless_gym
from endless_gym.display.window import Window

__all__ = ["recorded"]

IDS = MEMORY_GYM


@pytest.fixture
def invisible(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows are not shown and do not wait."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(Window, "wait", lambda self, fps: None)
    monkeypatch.setattr(pygame.time, "Clock", lambda: type("Clock", (), {"tick": lambda self, fps: None})())


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("mode", ["rgb_array", "debug_rgb_array"])
def test_a_batch_is_rendered_as_its_environments(where: Any, mode: str) -> None:
    # The clues of Endless-MortarMayhem are long, and a new one follows each executed command.
    options = {
        "Endless-MortarMayhem-v0": {"max_steps": 60, "initial_command_count": 2, "allowed_commands": 9},
        "MortarMayhem-v0": {"command_count": [3], "command_show_delay": [2], "explosion_delay": [3]},
    }
    for id in IDS if where is endless_gym.make_vec else list(options):
        given = options.get(id, SHORT[id])
        singles = [endless_gym.Env(id, mode, given) for _ in range(2)]
        with where(id, 2, autoreset="disabled", options=given, render_mode=mode) as envs:
            assert envs.render_mode == mode
            assert mode in envs.metadata["render_modes"]
            envs.action_space.seed(1)
            envs.reset(seed=3)
            for number, env in enumerate(singles):
                env.reset(seed=3 + number)
            compare(envs.render(), singles, id)
            for _ in range(40):
                actions = envs.action_space.sample()
                ended = envs.step(actions)[2]
                for env, action in zip(singles, actions, strict=True):
                    env.step(action)
                compare(envs.render(), singles, id)
                if ended.any():
                    envs.reset(options={"reset_mask": ended})
                    for number in np.flatnonzero(ended):
                        singles[number].reset()
                        # In the original, each picture advances the clue that is shown.
                        np.testing.assert_array_equal(envs.render()[number], singles[number].render(), err_msg=id)


def compare(pictures: Any, singles: list[endless_gym.Env], id: str) -> None:
    assert isinstance(pictures, tuple)
    same(pictures, [env.render() for env in singles], id)


def test_a_clue_after_an_executed_command_is_rendered_at_the_right_step() -> None:
    # Over many seeds, an agent that stands still executes some commands.
    id, options = (
        "Endless-MortarMayhem-v0",
        {"explosion_delay": [2], "explosion_duration": [1], "command_show_delay": [2]},
    )
    single = endless_gym.Env(id, "debug_rgb_array", options)
    with endless_gym.make_vec(id, 1, autoreset="disabled", options=options, render_mode="debug_rgb_array") as envs:
        later_clues = 0
        for seed in range(40):
            envs.reset(seed=seed)
            single.reset(seed=seed)
            compare(envs.render(), [single], id)
            for _ in range(30):
                _, reward, terminated, *_ = envs.step(np.zeros((1, 2), np.int64))
                single.step([0, 0])
                compare(envs.render(), [single], id)
                later_clues += int(reward[0] > 0)
                if terminated[0]:
                    break
        assert later_clues > 0


@pytest.mark.parametrize("where", WHERE)
def test_rendering_changes_nothing(where: Any) -> None:
    id = "Endless-MortarMayhem-v0"
    with (
        where(id, 2, seed=1, render_mode="debug_rgb_array", groups=2) as envs,
        endless_gym.make_vec(id, 2, seed=1) as plain,
    ):
        envs.reset()
        plain.reset()
        first = envs.render()
        same(envs.render(), first)
        other = envs.render(group=1)
        assert any((one != two).any() for one, two in zip(first, other, strict=True))
        for _ in range(30):
            envs.render()
            actions = plain.action_space.sample()
            same(envs.step(actions)[:4], plain.step(actions)[:4])
        assert plain.render() is None


def test_pictures_do_not_depend_on_the_observation() -> None:
    id = "Endless-SearingSpotlights-v0"
    grayscale = endless_gym.Frames(grayscale=True, stack=3)
    made = [{}, {"observation": "features"}, {"frames": grayscale}]
    envs = [endless_gym.make_vec(id, 1, seed=1, render_mode="rgb_array", **kwargs) for kwargs in made]
    singles = [endless_gym.Env(id, "rgb_array", **kwargs) for kwargs in made]
    for each in (*envs, *singles):
        each.reset(seed=1)
        each.step(each.action_space.sample() * 0 + 1)
    for each in envs[1:]:
        np.testing.assert_array_equal(each.render()[0], envs[0].render()[0])
    for each in singles:
        np.testing.assert_array_equal(each.render(), envs[0].render()[0])


@pytest.mark.parametrize("where", WHERE)
def test_pictures_equal_observations_also_when_episodes_end(where: Any) -> None:
    kwargs = {"options": {"max_steps": 6}, "autoreset": "same_step", "independent_episodes": True}
    with where("Endless-MortarMayhem-v0", 2, seed=1, render_mode="rgb_array", **kwargs) as envs:
        observation, _ = envs.reset()
        for _ in range(20):
            for picture, frame in zip(envs.render(), observation, strict=True):
                np.testing.assert_array_equal(picture, frame.swapaxes(0, 1))
            observation, *_ = envs.step(envs.action_space.sample())


def test_rgb_array_can_show_the_ground_truth_view() -> None:
    id = "MortarMayhem-v0"
    debug = endless_gym.Env(id, "debug_rgb_array")
    single = gymnasium.make(f"EndlessGym/{id}", render_mode="rgb_array", view="ground_truth")
    envs = gymnasium.make_vec(f"EndlessGym/{id}", 1, render_mode="rgb_array", view="ground_truth")
    for env in (debug, single, envs):
        env.reset(seed=1)
    wanted = debug.render()
    for _ in range(2):  # two pictures of one step are the same
        np.testing.assert_array_equal(single.render(), wanted)
        np.testing.assert_array_equal(envs.render()[0], wanted)


@pytest.mark.parametrize("make", [endless_gym.Env, *WHERE])
def test_unknown_render_modes_are_errors(make: Any) -> None:
    for kwargs, match in (
        ({"render_mode": "ansi"}, "render_mode must be None or one of .*rgb_array, debug_rgb_array, got 'ansi'"),
        ({"render_mode": "debug_rgb_array", "view": "agent"}, "one of ground_truth for 'debug_rgb_array', got 'agent'"),
        ({"render_mode": "rgb_array", "view": "mine"}, "one of agent, ground_truth for 'rgb_array', got 'mine'"),
        ({"view": "agent"}, "view must be None without a render_mode"),
    ):
        with pytest.raises(ValueError, match=match):
            make("MysteryPath-v0", **kwargs)
    if make is not endless_gym.Env:
        with pytest.raises(ValueError, match="None or one of rgb_array, debug_rgb_array, got 'human'"):
            make("MysteryPath-v0", render_mode="human")


@pytest.mark.libraries
@pytest.mark.parametrize("view", ["agent", "ground_truth"])
def test_stable_baselines3_records_videos(view: str, recorded: list[Any]) -> None:
    from stable_baselines3.common.vec_env import VecVideoRecorder

    from endless_gym.sb3 import EndlessVecEnv

    venv = EndlessVecEnv.make("MysteryPath-Grid-v0", 4, seed=1, render_mode="rgb_array", view=view)
    recorder = VecVideoRecorder(venv, "videos", lambda step: step == 0, video_length=3)
    recorder.reset()
    for _ in range(5):
        recorder.step(np.ones(4, np.int64))
    recorder.close()
    (frames,) = recorded
    size = 2 * (84 if view == "agent" else 336)
    assert {frame.shape for frame in frames} == {(size, size, 3)}


def test_without_a_display_the_window_says_so() -> None:
    program = """
import endless_gym
env = endless_gym.Env("MysteryPath-v0", "human")
try:
    env.reset(seed=1)
except RuntimeError as error:
    print(error)
"""
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment.pop("SDL_VIDEODRIVER", None)
    command = [sys.executable, "-c", program]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert 'render_mode="human" needs a display, and there is none' in ran.stdout
    assert "DISPLAY is None" in ran.stdout
    assert "SDL_VIDEODRIVER=dummy" in ran.stdout


def test_close_button_stops_the_environment_until_close(invisible: None) -> None:
    env = endless_gym.Env("MysteryPath-v0", "human")
    env.reset(seed=1)
    env.step([1, 0])
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    snapshot = env.snapshot()
    for call in (lambda: env.step([1, 0]), env.reset, env.render):
        with pytest.raises(endless_gym.WindowClosed, match="the window was closed"):
            call()
        assert not pygame.display.get_init()
    assert env.snapshot() == snapshot  # nothing was played
    env.close()
    env.reset(seed=1)
    assert pygame.display.get_init()
    env.close()


@pytest.mark.parametrize(("view", "mode"), [("agent", "rgb_array"), (None, "debug_rgb_array")])
@pytest.mark.parametrize("id", ["MortarMayhem-v0", "MysteryPath-v0", "SearingSpotlights-v0"])
def test_a_window_shows_each_step(id: str, view: Any, mode: str, invisible: None) -> None:
    shown, silent = endless_gym.Env(id, "human", view=view), endless_gym.Env(id, mode)
    for env in (shown, silent):
        env.reset(seed=3)
    for _ in range(3):
        picture = silent.render()
        scale = 336 // len(picture)
        window = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
        np.testing.assert_array_equal(window, picture.repeat(scale, 0).repeat(scale, 1))
        assert pygame.display.get_caption()[0] == f"{id}, seed 3"
        for env in (shown, silent):
            env.step([1, 2])
        assert shown.render() is None  # `step` has shown the picture
    shown.close()
    assert not pygame.display.get_init()


@pytest.mark.parametrize("view", ["agent", "ground_truth"])
@pytest.mark.parametrize("id", ["MortarMayhemB-v0", "MortarMayhemB-Grid-v0"])
def test_gymnasiums_play_takes_the_keys(id: str, view: str, invisible: None) -> None:
    env = gymnasium.make(f"EndlessGym/{id}", render_mode="rgb_array", view=view)
    free = endless_gym.spec(id).multi_discrete
    up, left, right, down = pygame.K_UP, pygame.K_LEFT, pygame.K_d, pygame.K_s
    # The keys pressed or released before each step, and the resulting action.
    steps = [
        ([], [0, 0], 0),
        ([(True, left)], [1, 0], 1),
        ([(True, up)], [1, 1], 3),
        ([(False, left), (True, right)], [2, 1], 3),
        ([(False, up)], [2, 0], 2),
        ([(True, down)], [2, 2], 2),
        ([(True, left)], [0, 2], 0),
        ([(False, left), (False, right), (False, down)], [0, 0], 0),
    ]
    played: list[Any] = []

    def post(number: int) -> None:
        for is_down, key in steps[number][0]:
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN if is_down else pygame.KEYUP, key=key))

    def callback(before: Any, after: Any, action: Any, *rest: Any) -> None:
        played.append(action)
        assert pygame.display.get_surface().get_size() == ((84, 84) if view == "agent" else (336, 336))
        if len(played) == len(steps):
            pygame.event.post(pygame.event.Event(pygame.QUIT))
        else:
            post(len(played))

    play(env, callback=callback, seed=1)
    for given, (_, multi, single) in zip(played, steps, strict=True):
        np.testing.assert_array_equal(given, multi if free else single)


def test_every_combination_of_keys_has_an_action() -> None:
    for id in IDS:
        env = endless_gym.Env(id)
        keys = env.get_keys_to_action()
        relevant = {key for combination in keys for key in combination}
        assert len(keys) == 2 ** len(relevant)
        assert all(action in env.action_space for action in keys.values())
