"""Tensors of other libraries that share the engine's memory."""

import subprocess
import sys
import types
import warnings

import numpy as np
import pytest
from support import WHERE

import endless_gym
from endless_gym import interop

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.libraries


@pytest.fixture
def observation() -> np.ndarray:
    return endless_gym.make_vec("MortarMayhem-v0", 4, seed=1).reset()[0]


def test_torch_shares_the_memory_without_a_warning(observation: np.ndarray) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tensor = endless_gym.torch_view(observation)
        other = torch.from_dlpack(endless_gym.DLPackView(observation))
    assert tensor.data_ptr() == other.data_ptr() == observation.ctypes.data
    np.testing.assert_array_equal(tensor.numpy(), observation)


def test_torch_from_numpy_shares_the_memory(observation: np.ndarray) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert torch.from_numpy(observation).data_ptr() == observation.ctypes.data


def test_torch_view_takes_every_dtype_and_strided_parts(observation: np.ndarray) -> None:
    envs = endless_gym.make_vec("Endless-MortarMayhem-v0", 4, seed=1)
    envs.reset()
    for array in envs.step(np.zeros((4, 2), dtype=np.int64))[:4]:
        np.testing.assert_array_equal(endless_gym.torch_view(array).numpy(), array)
    part = observation[1::2, :, ::3]
    np.testing.assert_array_equal(endless_gym.torch_view(part).numpy(), part)
    with pytest.raises(TypeError, match="str_"):
        endless_gym.torch_view(np.array(["a"]))


def test_a_tensor_keeps_the_batch() -> None:
    with endless_gym.serve("MortarMayhem-v0", 4, batches_held=2) as envs:
        tensor = endless_gym.torch_view(envs.reset()[0])
        kept = tensor.clone()
        for _ in range(5):
            envs.step(np.ones((4, 2), dtype=np.int64))
        assert torch.equal(tensor, kept)
        del tensor


def test_page_locking_without_cuda_says_so(observation: np.ndarray) -> None:
    if torch.cuda.is_available():
        assert endless_gym.pin_memory(observation)
        return
    with pytest.warns(UserWarning, match="no CUDA device"):
        assert not endless_gym.pin_memory(observation)


def test_the_whole_mapping_is_page_locked(observation: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    runtime = types.SimpleNamespace(cudaHostRegister=lambda *call: calls.append(call) or (0 if call[2] == 0 else 801))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "cudart", lambda: runtime)
    monkeypatch.setattr(interop, "_PINNED", set())
    assert endless_gym.pin_memory(observation)
    assert endless_gym.pin_memory(observation)
    assert [flags for _, _, flags in calls] == [8, 0]
    first, size, _ = calls[0]
    assert first <= observation.ctypes.data
    assert observation.ctypes.data + observation.nbytes <= first + size
    assert first % 4096 == size % 4096 == 0


def test_without_torch_the_message_says_so(observation: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.warns(UserWarning, match="not installed"):
        assert not endless_gym.pin_memory(observation)


@pytest.mark.slow
def test_jax_shares_the_memory_and_never_writes_to_it(libraries_python: str) -> None:
    program = """
import jax, jax.numpy as jnp, numpy as np, endless_gym

add_one = jax.jit(lambda frames: frames + jnp.uint8(1), donate_argnums=0)
for make in (endless_gym.make_vec, endless_gym.serve):
    with make("MortarMayhemB-Grid-v0", 3, seed=0) as envs:
        observation, _ = envs.reset()
        kept = {key: array.copy() for key, array in observation.items()}
        shared = jax.device_put(observation, may_alias=True)
        for key, array in observation.items():
            assert shared[key].unsafe_buffer_pointer() == array.ctypes.data, (make, key)
        frames = shared["visual_observation"]
        for _ in range(3):
            observation, *_ = envs.step(np.ones(3, dtype=np.int64))
        np.testing.assert_array_equal(frames, kept["visual_observation"])
        # XLA must not use this memory for the result: it would crash on a served batch.
        np.testing.assert_array_equal(add_one(frames), kept["visual_observation"] + np.uint8(1))
        frames = observation["visual_observation"]
        before = frames.copy()
        add_one(jax.device_put(frames, may_alias=True)).block_until_ready()
        np.testing.assert_array_equal(frames, before)
        part = jax.device_put(frames[1:], may_alias=True)
        np.testing.assert_array_equal(part, before[1:])
        del shared, frames, part, observation
print("done")
"""
    ran = subprocess.run([libraries_python, "-c", program], capture_output=True, text=True)
    assert ran.stdout == "done\n", ran.stdout + ran.stderr


@pytest.mark.parametrize("where", WHERE)
def test_from_dlpack_takes_the_arrays_themselves(where) -> None:
    with where("Endless-MortarMayhem-v0", 2, seed=1) as envs:
        envs.reset()
        observation, reward, *_, info = envs.step(np.zeros((2, 2), dtype=np.int64))
        for array in (observation, reward, info["ground_truth"]):
            same = np.from_dlpack(array)
            assert same.ctypes.data == array.ctypes.data
            assert same.flags.writeable == array.flags.writeable
            assert torch.from_dlpack(array).data_ptr() == array.ctypes.data


@pytest.mark.parametrize("where", [endless_gym.serve, endless_gym.make_vec])
def test_actions_that_numpy_cannot_read_are_refused_with_its_reason(where) -> None:
    zeros = torch.zeros(4)
    tensors = [zeros.to("meta"), zeros.requires_grad_(), torch.zeros(4, dtype=torch.int64).to_sparse()]
    with where("MortarMayhem-Grid-v0", 4, seed=1) as envs:
        envs.reset()
        for actions in tensors:
            with pytest.raises(TypeError, match=r"got Tensor: .*; pass `actions\.detach\(\)\.cpu\(\)`") as raised:
                envs.step(actions)
            assert raised.value.__cause__ is not None
        envs.step(torch.zeros(4, dtype=torch.int64))
