"""Nothing that a user does with the arrays of a step changes later steps, or kills the process."""

import copy
import gc
import io
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shared_memory_writes as writes
import torch

import endless_gym

EXPORTS = [writes.imported, lambda array: torch.from_dlpack(endless_gym.DLPackView(array))]
FRAMES = [None, endless_gym.Frames(grayscale=True, stack=2), endless_gym.Frames(channels_first=True, row_major=True)]


def arrays_of(returned: object) -> list[np.ndarray]:
    """All arrays in what `step` or `reset` returned, but for the time."""
    if isinstance(returned, dict):
        return [array for key, value in returned.items() if key != "t" for array in arrays_of(value)]
    if isinstance(returned, tuple):
        return [array for value in returned for array in arrays_of(value)]
    return [returned] if isinstance(returned, np.ndarray) and returned.dtype != object else []


@pytest.mark.parametrize("export", EXPORTS)
@pytest.mark.parametrize("frames", FRAMES)
@pytest.mark.parametrize("id", ["MortarMayhemB-v0", "Endless-MysteryPath-v0", "SearingSpotlights-v0"])
def test_writes_to_exported_memory_are_drawn_over(
    export: Callable[[np.ndarray], torch.Tensor], frames: endless_gym.Frames | None, id: str
) -> None:
    def make() -> endless_gym.EndlessVectorEnv:
        return endless_gym.make_vec(id, 3, seed=5, observation="rgb+features", frames=frames, autoreset="same_step")

    with make() as envs, make() as twin:
        envs.action_space.seed(2)
        returned, wanted = envs.reset(), twin.reset()
        exported = 0
        for _ in range(60):
            for one, other in zip(arrays_of(returned), arrays_of(wanted), strict=True):
                np.testing.assert_array_equal(one, other)
            for array in arrays_of(returned):
                if not array.flags.owndata:
                    export(array).fill_(77)
                    assert (array.view(np.uint8) != 0).any()
                    exported += 1
            actions = envs.action_space.sample()
            returned, wanted = None, None
            returned, wanted = envs.step(actions), twin.step(actions)
        assert exported >= 60


def test_an_exported_tensor_keeps_its_memory() -> None:
    with endless_gym.make_vec("SearingSpotlights-v0", 2, seed=5) as envs:
        tensor = writes.imported(envs.reset()[0]).fill_(9)
        for _ in range(5):
            envs.step(np.ones((2, 2), np.int64))
        assert (tensor == 9).all()


def test_a_buffer_that_is_not_exported_stays_known() -> None:
    """Reading, by all means that do not export a writable tensor, causes no full redraw: a pixel that is changed stays so."""
    with endless_gym.make_vec("MortarMayhem-Grid-v0", 1, seed=5, autoreset="disabled") as envs:
        envs.reset()
        for _ in range(3):
            observation = envs.step([0])[0]
            endless_gym.torch_view(observation).float().sum()
            endless_gym.interop.unchecked_torch_view(observation).sum()
            np.from_dlpack(endless_gym.DLPackView(observation)).sum()
        address = observation.ctypes.data
        corner = endless_gym.interop.unchecked_torch_view(observation)[0, 83, 83]
        wanted = (corner + 1).numpy()
        corner += 1
        del observation, corner
        gc.collect()
        held = [envs.step([0])[0] for _ in range(3)]
        (again,) = (observation for observation in held if observation.ctypes.data == address)
        np.testing.assert_array_equal(again[0, 83, 83], wanted)


def test_no_write_to_a_served_batch_succeeds() -> None:
    ran = subprocess.run(
        [sys.executable, Path(writes.__file__)], capture_output=True, text=True, timeout=120, check=False
    )
    assert ran.returncode == 0, ran.stderr[-3000:]
    assert int(ran.stdout) == 3 * (len(writes.MODES) * len(writes.tensor_writes()) + len(writes.array_writes()))


@pytest.mark.parametrize("mode", writes.MODES)
def test_no_write_to_a_tensor_of_this_process_succeeds(mode) -> None:
    observation, _ = endless_gym.make_vec("MortarMayhem-v0", 2, seed=1).reset()
    kept = observation.copy()
    with mode():
        writes.refused(writes.tensor_writes(), endless_gym.torch_view(observation))
    np.testing.assert_array_equal(observation, kept)


def test_messages_name_the_way() -> None:
    with endless_gym.serve("MortarMayhem-v0", 2) as envs:
        observation, _ = envs.reset()
        with pytest.raises(BufferError, match=r"export a copy: array.copy\(\)"):
            endless_gym.DLPackView(observation).__dlpack__()
        with pytest.raises(BufferError, match="read-only flag"):
            endless_gym.DLPackView(observation).__dlpack__(max_version=(0, 8))
        with pytest.raises(RuntimeError, match=r"write to a copy: tensor.clone\(\)"):
            endless_gym.torch_view(observation).zero_()
        with pytest.raises(BufferError, match=r"dl_device must be the CPU, \(1, 0\), got \(2, 0\)"):
            endless_gym.DLPackView(observation).__dlpack__(max_version=(1, 0), dl_device=(2, 0))
        for array in (observation, observation[:1]):
            shared = np.from_dlpack(endless_gym.DLPackView(array))
            assert shared.ctypes.data == array.ctypes.data
            assert not shared.flags.writeable
        copied = torch.from_dlpack(endless_gym.DLPackView(observation), copy=True)
        copied.zero_()
        assert torch.from_dlpack(endless_gym.DLPackView(observation.copy())).zero_().sum() == 0
        assert observation.any()
        del observation, array, shared, copied


def test_a_capsule_that_nobody_takes_releases_the_array() -> None:
    with endless_gym.make_vec("MortarMayhem-v0", 2) as envs:
        observation, _ = envs.reset()
        address = observation.ctypes.data
        endless_gym.DLPackView(observation).__dlpack__(max_version=(1, 0))
        endless_gym.DLPackView(observation).__dlpack__()
        del observation
        assert address in {envs.step(np.ones((2, 2), np.int64))[0].ctypes.data for _ in range(3)}


@pytest.mark.parametrize("where", [endless_gym.make_vec, endless_gym.serve])
def test_read_only_tensors_are_read_as_any_other(where) -> None:
    with where("MortarMayhem-v0", 2, seed=1, observation="rgb+features") as envs, warnings.catch_warnings():
        warnings.simplefilter("error")
        observation, _ = envs.reset()
        frames, features = observation["visual_observation"], observation["features"]
        tensor, plain = endless_gym.torch_view(frames), torch.tensor(frames)
        assert tensor.shape == plain.shape
        assert tensor.stride() == plain.stride()
        assert tensor.dtype is plain.dtype
        assert tensor.data_ptr() == frames.ctypes.data
        assert tensor[1].data_ptr() == frames[1].ctypes.data
        for call in (
            lambda t: t.float() / 255,
            lambda t: t.to(torch.float64),
            lambda t: t.to("cpu", copy=True),
            lambda t: t.clone(),
            lambda t: t + t,
            lambda t: 1 - t,
            lambda t: t == t[0],
            lambda t: t[:, 3, ..., 1],
            lambda t: t[torch.tensor([True, False])],
            lambda t: t[[1, 0]],
            lambda t: torch.stack([t, t]),
            lambda t: torch.cat((t, t), 1),
            lambda t: t.permute(0, 3, 1, 2).contiguous(),
            lambda t: t.reshape(2, -1).sum(1),
            lambda t: torch.where(t > 3, t, 0),
            lambda t: torch.nn.functional.conv2d(t.permute(0, 3, 1, 2).float(), torch.ones(2, 3, 8, 8)),
            lambda t: torch.nn.functional.one_hot(t[0, 0, 0].long(), 256),
            lambda t: torch.zeros(t.shape, dtype=t.dtype).copy_(t),
            lambda t: torch.as_tensor(t).sum(),
            lambda t: torch.empty_like(t).fill_(3),
            lambda t: copy.deepcopy(t),
            lambda t: pickle.loads(pickle.dumps(t)),
            lambda t: torch.tensor(t.numpy()),
            lambda t: torch.tensor(np.asarray(t)),
            lambda t: torch.tensor(np.asarray(t, np.float32)),
            lambda t: torch.tensor(t.tolist()),
            lambda t: torch.tensor(t.max().item()),
            lambda t: torch.vmap(lambda row: row.float().mean())(t),
        ):
            assert torch.equal(call(tensor), call(plain))
        assert repr(tensor[0, 0, 0]) == "ReadOnlyTensor(tensor([0, 0, 0], dtype=torch.uint8))"
        assert f"{tensor[0, 0, 0, 0]:03}" == "000"
        assert np.asarray(tensor, copy=False).ctypes.data == frames.ctypes.data
        with pytest.raises(ValueError, match="dtype must be uint8 or None for copy=False, got float32"):
            np.asarray(tensor, np.float32, copy=False)
        assert not tensor.requires_grad
        buffer = io.BytesIO()
        torch.save(tensor, buffer)
        buffer.seek(0)
        assert torch.equal(torch.load(buffer), plain)
        for result in (tensor.float(), tensor.clone(), copy.deepcopy(tensor), tensor + 0):
            assert type(result) is torch.Tensor
            result.zero_()
        # Gradients of weights that are multiplied with it.
        gradients = []
        for given in (endless_gym.torch_view(features), torch.tensor(features)):
            weight = torch.ones(features.shape[1], 3, requires_grad=True)
            torch.relu(given @ weight).square().sum().backward()
            gradients.append(weight.grad)
        assert torch.equal(*gradients)
        del tensor, observation, frames, features, given, call, result


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_read_only_tensors_in_modes_without_gradients(mode) -> None:
    with endless_gym.make_vec("MortarMayhem-v0", 2, seed=1, observation="features") as envs:
        features, _ = envs.reset()
        outside = endless_gym.torch_view(features)
        layer = torch.nn.Linear(features.shape[1], 3)
        wanted = layer(torch.tensor(features))
        with mode():
            for tensor in (outside, endless_gym.torch_view(features)):
                assert torch.equal(layer(tensor), wanted)
                assert torch.equal(tensor[0], torch.tensor(features[0]))
                assert torch.equal(tensor.clone().zero_(), torch.zeros(features.shape))
                for result in (tensor.double(), tensor.to("cpu", copy=True), tensor.type_as(torch.zeros(1).int())):
                    assert type(result) is torch.Tensor
                for write in (torch.Tensor.zero_, lambda t: t[0].zero_(), lambda t: t.view(-1).zero_()):
                    with pytest.raises(RuntimeError, match="read-only"):
                        write(tensor)
        assert torch.equal(layer(outside), wanted)
        assert torch.equal(outside[0], torch.tensor(features[0]))


def test_arrays_of_the_user_make_ordinary_tensors() -> None:
    array = np.zeros((2, 3), np.float32)
    tensor = endless_gym.torch_view(array)
    assert type(tensor) is torch.Tensor
    tensor += 1
    assert (array == 1).all()
    with endless_gym.make_vec("MortarMayhem-v0", 2, copy=True) as envs:
        assert type(endless_gym.torch_view(envs.reset()[0]).zero_()) is torch.Tensor
