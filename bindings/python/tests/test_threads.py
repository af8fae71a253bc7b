"""Threads that use the same vector environment."""

import asyncio
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import psutil
import pytest
from support import WHERE, stop

import endless_gym

#: Starts two vector environments, prints `cores` and the number of threads that each started, and ends.
COUNT = """
import os, endless_gym
from endless_gym import _native
counts, open_pools = [_native.cores()], []  # A closed pool's threads stay listed for a moment.
for threads in (None, 3):
    before = len(os.listdir("/proc/self/task"))
    open_pools.append(endless_gym.make_vec("MortarMayhem-Grid-v0", 4, threads))
    counts.append(len(os.listdir("/proc/self/task")) - before)
print(*counts)
"""

ID = "MortarMayhem-Grid-v0"
ACTIONS = np.array([0, 1, 2, 3])


@pytest.mark.parametrize("where", WHERE)
def test_a_thread_for_each_group_plays_what_one_thread_plays(where: Any) -> None:
    def play(envs: endless_gym.EndlessVectorEnv, group: int) -> list[Any]:
        steps = [envs.reset(group=group)[0].sum()]
        for number in range(60):
            envs.send((ACTIONS + number) % 4, group)
            observation, reward, terminated, _, info = envs.recv(group)
            assert info["group"] == group
            steps.append((observation.sum(), reward.tolist(), terminated.tolist()))
        return steps

    with endless_gym.make_vec(ID, 4, seed=3, groups=3) as alone:
        expected = [play(alone, group) for group in range(3)]
    with where(ID, 4, seed=3, groups=3) as envs, ThreadPoolExecutor(3) as threads:
        assert list(threads.map(play, [envs] * 3, range(3))) == expected


@pytest.mark.parametrize("where", WHERE)
def test_other_threads_render_and_save_while_one_steps(where: Any) -> None:
    with where(ID, 4, seed=3, render_mode="rgb_array") as envs:
        envs.reset()
        ended, shown = threading.Event(), []

        def observe() -> None:
            while not ended.is_set():
                pictures = envs.render()
                assert pictures is not None
                shown.append(pictures[0].shape)
                assert len(envs.running_episodes()) == 4 and envs.snapshot(2)

        with ThreadPoolExecutor(2) as threads:
            observers = [threads.submit(observe) for _ in range(2)]
            for _ in range(200):
                envs.step(ACTIONS)
            ended.set()
            for observer in observers:
                observer.result()
        assert shown and set(shown) == {(84, 84, 3)}


def test_calls_of_other_threads_succeed_while_one_waits_for_a_stopped_engine() -> None:
    with endless_gym.serve(ID, 4, groups=2) as envs, ThreadPoolExecutor(2) as threads:
        for group in range(2):
            envs.reset(group=group)
        snapshot = envs.snapshot(0)
        calls = [
            lambda: envs.reconnect(),
            lambda: envs.restore({0: snapshot}),
            lambda: envs.running_episodes(),
            lambda: (envs.send(ACTIONS, 0), envs.recv(0)),
        ]
        engine = psutil.Process(envs._engine.pid)
        for call in calls:
            stop(engine.pid)
            envs.send(ACTIONS, 1)
            waiting = threads.submit(envs.recv, 1)
            other = threads.submit(call)
            time.sleep(0.1)
            assert not waiting.done()
            with pytest.raises(RuntimeError, match="group 1 has a pending answer"):
                envs.restore({0: snapshot}, 1)
            engine.resume()
            assert waiting.result(30)[4]["group"] == 1
            other.result(30)


def test_a_thread_does_not_wait_for_one_that_waits_for_another_group() -> None:
    """A thread that had the connection to itself would keep it for up to 50 milliseconds at a time, and then for one."""
    took = []
    for _ in range(7):
        with endless_gym.serve(ID, 4, groups=3) as envs, ThreadPoolExecutor(2) as threads:
            for group in range(3):
                envs.reset(group=group)
            engine = psutil.Process(envs._engine.pid)
            stop(engine.pid)
            for group in range(2):
                envs.send(ACTIONS, group)
            waiting = [threads.submit(envs.recv, group) for group in range(2)]
            time.sleep(0.06)
            start = time.monotonic()
            envs.send(ACTIONS, 2)
            took.append(time.monotonic() - start)
            assert not any(each.done() for each in waiting)
            engine.resume()
            assert [each.result(30)[4]["group"] for each in waiting] == [0, 1]
            assert envs.recv()[4]["group"] == 2
    assert sorted(took)[3] < 0.01, took


@pytest.mark.parametrize("where", WHERE)
def test_steps_of_asyncio_threads_take_turns(where: Any) -> None:
    async def play(envs: endless_gym.EndlessVectorEnv) -> None:
        await asyncio.gather(*(asyncio.to_thread(envs.step, ACTIONS) for _ in range(20)))

    # `gather` holds all results.
    with where(ID, 4, seed=3, copy=True) as envs, endless_gym.make_vec(ID, 4, seed=3) as twin:
        envs.reset()
        twin.reset()
        asyncio.run(play(envs))
        for _ in range(20):
            twin.step(ACTIONS)
        np.testing.assert_array_equal(envs.step(ACTIONS)[0], twin.step(ACTIONS)[0])


def test_the_default_number_of_threads_is_that_of_the_process_affinity() -> None:
    """A pool of n threads starts n - 1; the calling thread is one of them."""
    for count in {1, len(os.sched_getaffinity(0))}:
        cores = sorted(os.sched_getaffinity(0))[:count]
        command = ["taskset", "--cpu-list", ",".join(map(str, cores)), sys.executable, "-c", COUNT]
        printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
        assert [int(number) for number in printed.split()] == [count, count - 1, 2]
