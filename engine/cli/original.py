"""Measures the steps per second of the original with random actions, resets included. Prints one number."""

import json
import os
import sys
import time
import warnings

warnings.filterwarnings("ignore")
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"

import gymnasium  # noqa: E402

__import__("popgym" if sys.argv[1].startswith("popgym-") else "memory_gym")

name, is_changed, _ = sys.argv[1].partition("?")
env = gymnasium.make(name, disable_env_checker=True).unwrapped
if is_changed:
    # The class without a difficulty takes arguments.
    env = type(env).__base__(**{each["name"]: each["default"] for each in json.loads(sys.argv[3])})
env.action_space.seed(0)
actions = [env.action_space.sample() for _ in range(1009)]
env.reset(seed=0)
steps, seconds, start = 0, float(sys.argv[2]), time.perf_counter()
while time.perf_counter() - start < seconds:
    _, _, terminated, truncated, _ = env.step(actions[steps % len(actions)])
    if terminated or truncated:
        env.reset()
    steps += 1
print(steps / (time.perf_counter() - start))
