"""Plays given actions in the original environments, and reports all that they return as a trace.

Reads one request a line: {"env", "options", "render", "episodes": [{"seed", "actions"}]}. Answers each with one line: a trace as
the engine's `trace` module describes it, or {"error": text} where the original raises. Needs memory-gym 1.0.2 on Python 3.11.
"""

import json
import os
import sys
import warnings
import zlib

warnings.filterwarnings("ignore")
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"

import gymnasium  # noqa: E402
import memory_gym  # noqa: E402, F401
import numpy  # noqa: E402


class Start(tuple):
    """The first tile of an endless path, which equals its coordinates.

    Version 1.0.2 compares the node itself with a pair of numbers, so that the first tile counts as progress; 1.0.3 compares
    its coordinates. This makes 1.0.2 do as 1.0.3 does.
    """

    x = property(lambda self: self[0])
    y = property(lambda self: self[1])


def plain(value):
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, numpy.ndarray)):
        return [plain(item) for item in value]
    value = value.item() if isinstance(value, numpy.generic) else value
    return None if value != value else value  # what is not a number is null in JSON


def checksum(array):
    return zlib.crc32(numpy.ascontiguousarray(array).tobytes())


def frame(observation):
    return observation["visual_observation"] if isinstance(observation, dict) else observation


def play(request):
    env = gymnasium.make(request["env"], disable_env_checker=True, render_mode="debug_rgb_array").unwrapped
    known = type(env).default_reset_parameters
    options = {name: value for name, value in request["options"].items() if name in known}
    episodes = []
    for wanted in request["episodes"]:
        observation, info = env.reset(seed=wanted["seed"], options=dict(options))
        if request["env"] == "Endless-MysteryPath-v0":
            env.start = Start((env.start.x, env.start.y))
        episode = {"seed": wanted["seed"], "reset_crc": checksum(frame(observation)), "reset_info": plain(info), "steps": []}
        if isinstance(observation, dict):
            episode["reset_vector"] = plain(observation["vector_observation"])
        for action in wanted["actions"]:
            given = action[0] if len(action) == 1 else list(action)
            observation, reward, done, _, info = env.step(given)
            step = [action, float(reward), bool(done), checksum(frame(observation)), plain(info)]
            if request["render"]:
                step.append(checksum(env.render()))
            episode["steps"].append(step)
            if done:
                break
        episodes.append(episode)
    return {"env": request["env"], "options": options, "episodes": episodes}


for line in sys.stdin:
    try:
        answer = play(json.loads(line))
    except Exception as error:  # Some combinations of options make the original raise; the caller decides.
        answer = {"error": f"{type(error).__name__}: {error}"}
    print(json.dumps(answer), flush=True)
