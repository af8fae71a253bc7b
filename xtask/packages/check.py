"""Checks an installed package: imports it, and steps an environment in this process and in an engine's."""

import importlib.metadata
import os
import platform
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import gymnasium
import numpy as np

import endless_gym

ENV = "Endless-MortarMayhem-v0"
STEPS = 50


def play(envs: gymnasium.vector.VectorEnv) -> tuple[float, np.ndarray]:
    """Play with the same actions in each call; returns the sum of the rewards and the last frames."""
    actions = np.random.default_rng(1).integers(0, 3, size=(STEPS, *envs.action_space.shape))
    observation, _ = envs.reset(seed=1)
    rewards = 0.0
    for action in actions:
        observation, reward, *_ = envs.step(action)
        rewards += float(reward.sum())
    return rewards, np.array(observation)


version = importlib.metadata.version("endless-gym")
expected = sys.argv[1]
if version != expected or endless_gym.__version__ != expected:
    sys.exit(
        f"the version must be {expected}, got {version} of the package and {endless_gym.__version__} of the module"
    )
licences = [file.name for file in importlib.metadata.files("endless-gym") or [] if "licenses" in file.parts]
if sorted(licences) != ["LICENSE-APACHE", "LICENSE-MIT", "NOTICE"]:
    sys.exit(f"the package must contain both licences and NOTICE, got {licences}")

with gymnasium.make(f"EndlessGym/{ENV}") as env:
    env.reset(seed=1)
    env.step(env.action_space.sample())
in_process = gymnasium.make_vec(f"EndlessGym/{ENV}", num_envs=4)
rewards, frames = play(in_process)
in_process.close()
with endless_gym.serve(ENV, num_envs=4) as served:
    served_rewards, served_frames = play(served)
if rewards != served_rewards or not np.array_equal(frames, served_frames) or frames.std() == 0:
    sys.exit("an engine process and this process must give the same frames and rewards")
if sys.argv[2] == "page":
    browser = Path("browser")
    browser.write_text('#!/bin/sh\necho "$1" > opened.part; mv opened.part opened\n')
    browser.chmod(0o700)
    episode = ["SearingSpotlights-v0", "--seed", "9", "--option", "num_coins=[3]"]
    with subprocess.Popen(
        [f"{sys.prefix}/bin/endless", "play", *episode, "--open"],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"BROWSER": str(browser.absolute())},
    ) as server:
        assert server.stdout is not None
        url = server.stdout.readline().split()[-1]
        address, _, link = url.partition("#")
        with urllib.request.urlopen(f"{address}engine.wasm") as answer:
            is_page = answer.read(4) == b"\0asm" and link == "env=SearingSpotlights-v0&seed=9&num_coins=%5B3%5D"
        server.terminate()
    end = time.monotonic() + 60
    while not Path("opened").exists() and time.monotonic() < end:
        time.sleep(0.01)
    opened = Path("opened").read_text() if Path("opened").exists() else ""
    if not is_page or server.returncode or opened != f"{url}\n":
        sys.exit(f"`endless play --open` must serve the page and open it, got {url} and status {server.returncode}")
    command = [f"{sys.prefix}/bin/endless", "play", "popgym-RepeatFirstEasy-v0"]
    refused = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if refused.returncode != 1 or "is not on the page" not in refused.stderr:
        sys.exit(f"`endless play` must refuse an environment that is not on the page, got {refused}")
print(f"CPython {platform.python_version()}: endless-gym {version}, {STEPS} steps in process and served")
