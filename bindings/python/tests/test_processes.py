"""Processes that die, are interrupted, or fork."""

import gc
import logging
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import await_end_of_engines, engine_of_program, same, segments, stop

import endless_gym
from endless_gym.program import program

ID = "Endless-MortarMayhem-v0"
ACTIONS = np.zeros((4, 2), dtype=np.int64)


def test_ctrl_c_reaches_python_while_it_waits() -> None:
    program = f"""
import endless_gym, os, signal
# Processes that a shell starts in the background ignore Ctrl-C, and so do their children.
signal.signal(signal.SIGINT, signal.default_int_handler)
with endless_gym.serve({ID!r}, 4) as envs:
    envs.reset()
    os.kill(envs._engine.pid, signal.SIGSTOP)
    os.waitid(os.P_PID, envs._engine.pid, os.WSTOPPED)  # It may answer before it stops.
    try:
        print("waiting", flush=True)
        envs.step([[0, 0]] * 4)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
    os.kill(envs._engine.pid, signal.SIGCONT)
"""
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "waiting\n"
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=20)[0] == "interrupted\n"
    assert process.returncode == 0


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_child_does_no_harm() -> None:
    envs, inside = endless_gym.serve(ID, 4), endless_gym.make_vec(ID, 64, num_threads=2)
    many = np.zeros((64, 2), dtype=np.int64)
    envs.reset()
    inside.reset()
    inside.step(many)
    child = os.fork()
    if child == 0:
        refused = 0
        for those, actions in ((envs, ACTIONS), (inside, many)):
            try:
                those.step(actions)
            except RuntimeError:
                refused += 1
        # The engine does not end when the child deletes its copy of the environments.
        del envs, inside, those
        gc.collect()
        os._exit(refused)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 2
    for _ in range(10):
        envs.step(ACTIONS)
        inside.step(many)
    envs.close()


def test_reconnecting_to_a_restarted_engine() -> None:
    with engine_of_program("again", ID, "--num-envs=4") as first:
        envs = endless_gym.connect("again")
        envs.reset()
        first.kill()
        first.wait()
    with pytest.raises(endless_gym.EngineLost):
        envs.step(ACTIONS)
    with engine_of_program("again", ID, "--num-envs=4"):
        found = envs.reconnect()
        assert found.restarted and found.groups[0].step == 0 and found.groups[0].lost_step == 1
        assert found.groups[0].last_request in ("played", "not_played")
        assert envs.reset(seed=1)[0].shape == (4, 84, 84, 3)
        envs.step(ACTIONS)
        envs.close()


def test_an_interrupted_step_is_played_once() -> None:
    with endless_gym.serve(ID, num_envs=4, seed=1) as envs, endless_gym.make_vec(ID, num_envs=4, seed=1) as twin:
        envs.reset()
        twin.reset()
        engine = envs._engine.pid
        stop(engine)
        # Processes that a shell starts in the background ignore Ctrl-C.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        interrupt = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
        interrupt.start()
        with pytest.raises(KeyboardInterrupt):
            envs.step(ACTIONS)
        interrupt.join()
        signal.signal(signal.SIGINT, before)
        found = envs.reconnect()
        assert not found.restarted and found.groups[0] == (1, None, "pending")
        with pytest.raises(RuntimeError, match="group 0 has a pending answer; call `recv`"):
            envs.step(ACTIONS)
        os.kill(engine, signal.SIGCONT)
        np.testing.assert_array_equal(envs.recv()[0], twin.step(ACTIONS)[0])
        assert envs.reconnect().groups[0] == (2, None, "played")
        for _ in range(20):
            np.testing.assert_array_equal(envs.step(ACTIONS)[0], twin.step(ACTIONS)[0])


@pytest.mark.parametrize("where", [endless_gym.serve, endless_gym.make_vec])
@pytest.mark.parametrize("kind", ["step", "recv"])
@pytest.mark.parametrize("arguments", [{}, {"autoreset": "same_step", "episode_info": True}])
def test_the_result_of_an_interrupted_step_is_kept(where: Any, kind: str, arguments: dict[str, Any]) -> None:
    """Signals at random moments around a step, against environments that play the same without interrupts.

    A busy machine delivers most signals after the step, so there are more steps until enough were interrupted.
    """
    draws, interrupted, received = random.Random(1), 0, 0
    armed = False

    def interrupt(number: int, frame: object) -> None:
        """A worker thread may run the handler late, when the step has returned."""
        nonlocal armed
        if armed:
            armed = False
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with where(ID, 4, 1, seed=1, **arguments) as envs, endless_gym.make_vec(ID, 4, 1, seed=1, **arguments) as twin:
            envs.reset()
            twin.reset()
            steps = 0
            while steps < 150 or (steps < 10_000 and not (interrupted > 10 and received)):
                steps += 1
                result = None
                if kind == "recv":
                    envs.send(ACTIONS)
                try:
                    armed = True
                    signal.setitimer(signal.ITIMER_REAL, draws.uniform(1e-6, 1e-3))
                    result = envs.step(ACTIONS) if kind == "step" else envs.recv()
                    armed = False
                except KeyboardInterrupt:
                    interrupted += 1
                if result is None:
                    try:
                        result = envs.recv()
                        received += 1
                    except RuntimeError as error:
                        assert kind == "step" and "nothing was sent" in str(error)
                        result = envs.step(ACTIONS)  # It was not played.
                expected = twin.step(ACTIONS)
                for one, two in zip(result[:4], expected[:4], strict=True):
                    np.testing.assert_array_equal(one, two)
            with pytest.raises(RuntimeError, match="nothing was sent to group 0"):
                envs.recv()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert interrupted > 10 and received > 0


def test_a_request_drops_the_result_that_was_kept() -> None:
    with endless_gym.make_vec(ID, 4, seed=1) as envs, endless_gym.make_vec(ID, 4, seed=1) as twin:
        for each in (envs, twin):
            each.reset()
            each.step(ACTIONS)
        envs._kept[0] = envs._backend.step(ACTIONS)  # as if interrupted
        twin.step(ACTIONS)
        np.testing.assert_array_equal(envs.step(ACTIONS)[0], twin.step(ACTIONS)[0])
        with pytest.raises(RuntimeError, match="nothing was sent"):
            envs.recv()


def test_package_includes_the_program() -> None:
    command = [sys.executable, "-c", "import sys; from endless_gym.cli import main; sys.exit(main())"]
    listed = subprocess.run([*command, "list", "--json"], capture_output=True, text=True, check=True)
    assert ID in listed.stdout
    demo = [*command, "demo", "--seconds", "0.5", "--num-envs", "8"]
    assert subprocess.run(demo, capture_output=True, check=False).returncode == 0


def test_a_running_engine_without_final_observations() -> None:
    """`endless serve --autoreset same-step` starts such an engine."""
    with (
        engine_of_program("without-final", ID, "--num-envs=4", "--seed=1", "--autoreset=same-step"),
        endless_gym.connect("without-final") as envs,
        endless_gym.make_vec(ID, 4, seed=1, autoreset="same_step") as twin,
    ):
        assert not envs.has_final_observation
        assert twin.has_final_observation
        envs.reset()
        twin.reset()
        ends = 0
        for _ in range(100):
            (*step, info), (*wanted, whole) = (each.step(ACTIONS) for each in (envs, twin))
            same(step, wanted)
            assert info.keys() == whole.keys() - {"final_obs", "_final_obs"}
            if "final_info" in info:
                np.testing.assert_array_equal(info["final_info"]["reward"], whole["final_info"]["reward"])
            ends += int(step[2].sum())
        assert ends > 4


#: Starts an engine or connects to one, forks a worker that outlives it, and prints the worker's process id.
FORKING = """
import os, sys, time, endless_gym
envs = endless_gym.connect("forking") if sys.argv[1] == "connect" else endless_gym.serve("Endless-MortarMayhem-v0", 4)
envs.reset()
worker = os.fork()
if worker == 0:
    time.sleep(60)
    os._exit(0)
print(worker, flush=True)
time.sleep(60)
"""


def forking(how: str) -> tuple[subprocess.Popen, int]:
    process = subprocess.Popen([sys.executable, "-c", FORKING, how], stdout=subprocess.PIPE, text=True)
    return process, int(process.stdout.readline())


def test_an_engine_ends_with_its_parent_while_a_forked_worker_lives() -> None:
    process, worker = forking("serve")
    try:
        assert len(endless_gym.running_engines()) == 1
        process.kill()
        process.wait()
        await_end_of_engines(3)
    finally:
        os.kill(worker, signal.SIGKILL)


def test_a_dead_trainer_is_replaced_while_its_forked_worker_lives() -> None:
    with engine_of_program("forking", ID, "--num-envs=4"):
        process, worker = forking("connect")
        try:
            process.kill()
            process.wait()
            with endless_gym.connect("forking", timeout=5) as envs:
                envs.reset()
                envs.step(ACTIONS)
        finally:
            os.kill(worker, signal.SIGKILL)


def test_a_dead_trainer_is_replaced_by_another_fork_of_the_same_process() -> None:
    program_text = """
import os, signal, endless_gym
print(endless_gym.running_engines(), flush=True)
read, write = os.pipe()
first = os.fork()
if first == 0:
    envs = endless_gym.connect("family")
    envs.reset()
    os.write(write, b"x")
    signal.pause()
os.read(read, 1)
os.kill(first, signal.SIGKILL)
os.waitpid(first, 0)
second = os.fork()
if second == 0:
    with endless_gym.connect("family", timeout=5) as envs:
        envs.reset()
        print("connected", flush=True)
    os._exit(0)
os.waitpid(second, 0)
"""
    with engine_of_program("family", ID, "--num-envs=4"):
        endless_gym.connect("family").close()
        family = subprocess.run([sys.executable, "-c", program_text], stdout=subprocess.PIPE, text=True, timeout=60)
        assert family.stdout.splitlines() == ["['family']", "connected"]


def test_an_engine_resumes_from_its_checkpoint(tmp_path: Path) -> None:
    file = tmp_path / "state"
    settings = {"num_envs": 4, "groups": 2, "seeds": range(50), "seed": 3, "autoreset": "same_step"}
    twin = endless_gym.make_vec(ID, **settings)

    def step(envs: endless_gym.EndlessVectorEnv) -> None:
        for group in range(2):
            for each in (envs, twin):
                each.send(ACTIONS + 1, group)
            same(envs.recv(group)[:4], twin.recv(group)[:4])

    with endless_gym.serve(ID, **settings, checkpoint=file, checkpoint_every=3600.0) as envs:
        for each in (envs, twin):
            each.reset()
        for _ in range(150):
            step(envs)
        assert envs.checkpoint() == [151, 151]
        os.kill(envs._engine.pid, signal.SIGKILL)
    with pytest.raises(RuntimeError, match="state exists; resume from it"):
        endless_gym.serve(ID, **settings, checkpoint=file)
    with endless_gym.serve(ID, **settings, checkpoint=file, resume=True) as envs:
        with pytest.raises(RuntimeError, match="reset all of them first"):
            envs.snapshot(0)
        for group in range(2):
            np.testing.assert_array_equal(envs.adopt(group)[0], twin.adopt(group)[0])
        for _ in range(50):
            step(envs)
    with endless_gym.serve(ID, **settings, checkpoint=file, resume=True) as envs:
        assert [group.step for group in envs.reconnect().groups] == [202, 202]
        for group in range(2):
            envs.adopt(group), twin.adopt(group)
        step(envs)
    twin.close()
    with pytest.raises(ValueError, match="checkpoint must name a file"):
        endless_gym.serve(ID, resume=True)
    with endless_gym.serve(ID) as envs, pytest.raises(RuntimeError, match="no checkpoint file"):
        envs.checkpoint()


def test_an_engine_killed_while_it_saves_leaves_a_whole_checkpoint(tmp_path: Path) -> None:
    before, file, draws, last = segments(), tmp_path / "state", np.random.default_rng(3), 0
    for _ in range(6):
        with endless_gym.serve(ID, 4, checkpoint=file, checkpoint_every=0.001, resume=file.exists()) as envs:
            step = envs.reconnect().groups[0].step
            assert step >= last
            envs.reset()
            end = time.monotonic() + draws.uniform(0.05, 0.3)
            while time.monotonic() < end:
                envs.step(ACTIONS)
            last = envs.checkpoint()[0]
            envs.send(ACTIONS)
            os.kill(envs._engine.pid, signal.SIGKILL)
    assert {each.name for each in tmp_path.iterdir()} <= {"state", "state.new", "state.lock"}
    # Closing the environments removed what the killed engines left.
    assert segments() <= before


def test_events_are_logged_by_python(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="endless_gym"), endless_gym.serve(ID) as envs:
        envs.reset()
    for name, part in (
        ("endless_gym", "connected to an engine"),
        ("endless_gym.engine", "a trainer sends its first request"),
    ):
        assert any(part in record.message for record in caplog.records if record.name == name), caplog.records
    assert {record.name for record in caplog.records} == {"endless_gym", "endless_gym.engine"}
    assert {record.levelno for record in caplog.records} == {logging.INFO}
    caplog.clear()
    with endless_gym.serve(ID) as envs:
        envs.reset()
    assert caplog.records == []


def test_the_errors_of_an_engine_are_logged(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    folder = tmp_path / "removed"
    folder.mkdir()
    end = time.monotonic() + 60
    with endless_gym.serve(ID, checkpoint=folder / "state", checkpoint_every=0.02) as envs:
        shutil.rmtree(folder)
        while not caplog.records and time.monotonic() < end:
            envs.reset()
        assert "cannot save a checkpoint" in caplog.text
    # The last save, at the end of the engine, fails too, so the engine reports an error.
    last = caplog.records[-1]
    assert (last.name, last.levelno) == ("endless_gym.engine", logging.ERROR)
    assert last.message.startswith(f"engine {envs._engine.pid}: checkpoint {folder}/state cannot be written"), last


def test_ctrl_c_ends_the_program_while_it_starts(tmp_path: Path) -> None:
    native = tmp_path / "native.py"
    native.write_text(
        "import signal\n"
        "def endless(arguments, executable):\n"
        "    print(signal.getsignal(signal.SIGINT), flush=True)\n"
        "    return len(arguments)\n"
    )
    command = [*program()[:-1], str(native), "serve"]
    for ignored, expected in ((False, signal.SIG_DFL), (True, signal.SIG_IGN)):
        before = signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.default_int_handler)
        try:
            found = subprocess.run(command, capture_output=True, text=True)
        finally:
            signal.signal(signal.SIGINT, before)
        assert (found.returncode, found.stdout) == (1, f"{expected!s}\n"), found
