"""Checks on a stand-in for a CUDA device, each in a process of its own: `python on_other_device.py FOLDER`."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import other_device
import pytest
import test_agents_operations
import torch
from agents_helpers import ALL_HEADS, changed, collecting, progress, settings, small
from kills import ended
from other_device import NAME, in_flight, locked

from endless_gym import EndlessVectorEnv, make_vec, serve
from endless_gym_agents.common import own
from endless_gym_agents.common.clock import Clock
from endless_gym_agents.environments.recovery import RecoverableEngine
from endless_gym_agents.memories import MEMORIES
from endless_gym_agents.memories.sequence_model import Stack
from endless_gym_agents.training.ppo import learn, make_optimizer
from endless_gym_agents.training.train import train
from endless_gym_agents.training.transfers import Upload

WHERE: dict[str, Callable[..., EndlessVectorEnv]] = {"thread": make_vec, "process": serve}
ID = "Endless-MortarMayhem-v0"


def arrays_of(observation: Any, info: dict[str, Any]) -> list[np.ndarray]:
    return [*(observation.values() if isinstance(observation, dict) else [observation]), info["ground_truth"]]


def registered() -> list[int]:
    """Addresses of the shared memory that is page-locked."""
    return [first for first, (_, mapped) in locked.items() if mapped is not None]


def played(make: Callable[..., EndlessVectorEnv], autoreset: str, upload: type[Upload]) -> None:
    """Upload what two groups return while they step, and compare it with what other environments return."""
    arguments = {"num_envs": 2, "groups": 2, "seed": 4, "autoreset": autoreset, "observation": "rgb+features"}
    arguments |= {"options": {"max_steps": 9}}
    limit = {"batches_held": 2} if make is serve else {}
    ends = 0
    with make(ID, pin_memory=True, **arguments, **limit) as envs, make_vec(ID, **arguments) as twin:
        uploads, flying = [upload(torch.device(NAME, 0)) for _ in range(2)], 0
        for step in range(30):
            for group in range(2):
                if step == 0:
                    results = [each.reset(group=group) for each in (envs, twin)]
                else:
                    results = []
                    for each in (envs, twin):
                        each.send(np.full((2, 2), step % 3), group)
                        returned = each.recv(group)
                        results.append((returned[0], returned[4]))
                    ends += int(returned[2].sum())
                tensors = [uploads[group].tensor(array) for array in arrays_of(*results[0])]
                wanted = [array.copy() for array in arrays_of(*results[1])]
                del results
                flying += len(in_flight)
                # The arrays of one step may be in flight in the next.
                if step % 2:
                    uploads[group].wait()
                for tensor, array in zip(tensors, wanted, strict=True):
                    np.testing.assert_array_equal(tensor.here.numpy(), array)
        assert flying > 60
        assert len(registered()) == (2 if make is serve else 0)
    assert ends > 5
    assert not registered()


def copies(folder: Path) -> None:
    """Both kinds of environments, with all auto-reset modes."""
    for make in WHERE.values():
        for autoreset in ("same_step", "next_step"):
            played(make, autoreset, Upload)


class Careless(Upload):
    """Does not keep the arrays, which is wrong."""

    def copy(self, array: np.ndarray, target: torch.Tensor) -> None:
        super().copy(array, target)
        self._kept.clear()


def early_release(folder: Path) -> None:
    """The stand-in notices that an array is released before its upload is complete."""
    for make in WHERE.values():
        try:
            played(make, "same_step", Careless)
        except RuntimeError as error:
            assert "changed while the device was reading it" in str(error)
        else:
            raise AssertionError("not noticed")
        in_flight.clear()


def killed_engine(folder: Path) -> None:
    """An engine process is killed and replaced while uploads from its memory are in flight."""
    arguments = {"num_envs": 4, "seed": 4, "groups": 2}
    with make_vec(ID, **arguments) as twin:
        engine = RecoverableEngine(
            "restart",
            lambda: serve(ID, pin_memory=True, batches_held=2, **arguments),
            lambda: make_vec(ID, pin_memory=True, **arguments),
        )
        engine.report = lambda line: None
        uploads = [Upload(torch.device(NAME, 0)) for _ in range(2)]
        for group in range(2):
            np.testing.assert_array_equal(engine.reset(group=group)[0], twin.reset(group=group)[0])
        # The last failure is one too many: the environments are then in this process.
        for step in range(5):
            tensors, wanted = [], []
            for group in range(2):
                for envs in (engine, twin):
                    envs.send(np.full((4, 2), step % 3), group)
                tensors.append(uploads[group].tensor(engine.recv(group)[0]))
                wanted.append(twin.recv(group)[0].copy())
            old = registered()
            assert len(in_flight) == 2
            assert len(old) == (0 if engine.failure else 2)
            if not engine.failure:
                os.kill(engine.unwrapped._engine.pid, signal.SIGKILL)
                engine.unwrapped._engine._process.wait()
                for group in range(2):
                    engine.snapshot(0, group)
                assert not in_flight
            for upload, tensor, array in zip(uploads, tensors, wanted, strict=True):
                upload.wait()
                np.testing.assert_array_equal(tensor.here.numpy(), array)
        assert engine.failure
        engine.close()
    assert not registered()


def closing(folder: Path) -> None:
    """Environments are closed while uploads are in flight, and by an exception."""
    for engine in WHERE:
        given = changed(settings("gru"), **ALL_HEADS, threads=1)
        given = changed(given, environment={"num_envs": 4, "groups": 2, "engine": engine}, ppo={"steps": 8})
        with collecting(given, NAME) as collector:
            collector.collect(Clock())
            # The last rewards and observation of each group, and the ground truth of the last one.
            assert len(in_flight) == 5
            assert len(registered()) == (2 if engine == "process" else 0)
        assert not registered()
        other_device.complete()
        try:
            with serve(ID, 2, pin_memory=True) as envs:
                Upload(torch.device(NAME, 0)).tensor(envs.reset()[0])
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            assert not registered() and not in_flight


def kept_arrays(folder: Path) -> None:
    """The user may hold as many batches as without page-locking, and after the end."""
    upload = Upload(torch.device(NAME, 0))
    with serve(ID, 2, seed=3, batches_held=3, pin_memory=True) as envs, make_vec(ID, 2, seed=3) as twin:
        held = [envs.reset()[0], *(envs.step(np.ones((2, 2), np.int64))[0] for _ in range(2))]
        wanted = [twin.reset()[0], *(twin.step(np.ones((2, 2), np.int64))[0] for _ in range(2))]
        tensors = [upload.tensor(array) for array in held]
    upload.wait()
    for tensor, array, copied in zip(held, wanted, tensors, strict=True):
        np.testing.assert_array_equal(tensor, array)
        np.testing.assert_array_equal(copied.here.numpy(), array)


def rollouts(folder: Path) -> None:
    """Agents collect the same on the device as on the CPU, whatever their observations."""
    flags = {
        "gru": ALL_HEADS,
        "stack": {"environment": {"observation": "rgb"}},
        "position": {"env": "MortarMayhemB-Grid-v0", "environment": {"observation": "features"}},
    }
    for agent, changes in flags.items():
        given = changed(changed(settings(agent), **changes), threads=1, ppo={"steps": 6})
        collected = []
        for device, engine in (("cpu", "thread"), (NAME, "thread"), (NAME, "process")):
            environment = {"num_envs": 4, "groups": 2, "engine": engine, "num_threads": 1}
            with collecting(changed(given, environment=environment), device) as collector:
                for _ in range(2):
                    segment, _ = collector.collect(Clock())
                parts = [*segment.observation.values(), segment.action, segment.reward, segment.done]
                parts += [] if segment.ground_truth is None else [segment.ground_truth]
                collected.append([part.cpu().clone() for part in parts])
        for others in collected[1:]:
            assert all(torch.equal(one, other) for one, other in zip(collected[0], others, strict=True)), agent


@contextmanager
def killed_before_receiving(number: int) -> Iterator[None]:
    """Kill the engine before this call of `receive` of an engine."""
    received, calls = RecoverableEngine.recv, 0

    def recv(self: RecoverableEngine, group: int) -> Any:
        nonlocal calls
        if calls == number:
            # The upload of the last ground truth.
            assert in_flight
            os.kill(self.unwrapped._engine.pid, signal.SIGKILL)
        calls += 1
        return received(self, group)

    RecoverableEngine.recv = recv
    yield
    RecoverableEngine.recv = received


def training(folder: Path) -> None:
    """Runs have the same results with copies that wait, in process, with an engine, and with an engine that is killed."""

    def trained(name: str, engine: str) -> list[dict[str, Any]]:
        given = changed(small("gru", folder / name, 2, engine=engine), **ALL_HEADS)
        return progress(train(changed(given, device=NAME)))

    inside, served = trained("thread", "thread"), trained("process", "process")
    with killed_before_receiving(37):
        killed = trained("killed", "process")
    other_device.begin = lambda address, size, finish: finish()
    assert trained("waiting", "thread") == inside == served == killed


def waits(folder: Path) -> None:
    """A rollout waits only for the actions and copies each observation once; an update waits only for its metrics."""
    for agent in (*test_agents_operations.BUDGETS, "stack"):
        given = test_agents_operations.small(agent)
        steps, groups = given.ppo.steps, given.environment.groups
        with collecting(given, NAME) as collector:
            optimizer = make_optimizer(collector.agent, 1e-3)
            for _ in range(2):
                other_device.waits.clear()
                other_device.uploads.clear()
                segment, _ = collector.collect(Clock())
                # Each action is copied to the CPU.
                assert other_device.waits == {"copy_": steps * groups}, agent
                # Each group's observation, including the last, is uploaded once; rewards and ends of episodes together.
                assert other_device.uploads == {(2, 4): steps * groups, (4, 17): (steps + 1) * groups}, agent
                states = [memory.state for memory in collector.memories]
                other_device.waits.clear()
                learn(collector.agent, optimizer, segment, states, 1, given.ppo, torch.Generator().manual_seed(0))
                assert other_device.waits.total() == 1, agent


def rejects(folder: Path) -> None:
    """The stand-in rejects what CUDA rejects."""
    layer, here = torch.nn.Linear(2, 2).to(NAME), torch.ones(3, 2)
    assert layer(here.to(NAME)).device.type == NAME and layer(here.to(NAME)).cpu().device.type == "cpu"
    for wrong, message in (
        (lambda: layer(here), "addmm: tensors on two devices"),
        (lambda: here.to(NAME) + here, "add: tensors on two devices"),
        (lambda: here.to(NAME).numpy(), "numpy"),
    ):
        with pytest.raises((RuntimeError, TypeError), match=message):
            wrong()


def memories(folder: Path) -> None:
    """Outputs, states and gradients of sequences, where scans over steps are associative, and outputs of steps."""

    def computed(name: str, place: str) -> list[torch.Tensor]:
        torch.manual_seed(1)
        model = Stack(own.load("--agent", MEMORIES[name], torch.nn.Module), 16, 16, 2, {})
        for parameter in model.parameters():
            parameter.data += 0.1 * torch.randn_like(parameter)
        x, resets = torch.randn(90, 3, 16), torch.rand(90, 3) < 0.05
        state = {key: torch.zeros(3, *shape) for key, shape in model.state_shapes.items()}
        model, x, resets = model.to(place), x.to(place).requires_grad_(), resets.to(place)
        state = {key: part.to(place) for key, part in state.items()}
        y, after = model.sequence(x, state, resets)
        gradients = torch.autograd.grad((y * y.detach().roll(1, -1)).mean(), [x, *model.parameters()])
        return [part.detach().cpu() for part in (y, *after.values(), *gradients, *model.step(x[0], after)[1].values())]

    for name in MEMORIES:
        for here, there in zip(computed(name, "cpu"), computed(name, NAME), strict=True):
            assert here.abs().max() > 0
            torch.testing.assert_close(there, here, rtol=1e-4, atol=1e-4 * float(here.abs().max()), msg=name)


CHECKS = (copies, early_release, killed_engine, closing, kept_arrays, rollouts, training, waits, rejects, memories)


def main() -> None:
    """Run each check in a process of its own, and print the names of those that pass."""
    other_device.register()
    for check in CHECKS:
        with other_device.device():
            assert ended(lambda check=check: check(Path(sys.argv[1]))) == 0, check.__name__
        print(f"passed: {check.__name__}", flush=True)


if __name__ == "__main__":
    main()
