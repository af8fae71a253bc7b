"""Tensors of other libraries that share the engine's memory."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
from support import WHERE, engine_of_program, same

import endless_gym
from endless_gym import interop
from endless_gym.requests.configuration import checked_arguments
from endless_gym.specs import json_text

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.libraries


ENDLESS = "Endless-MortarMayhem-v0"


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


@pytest.mark.parametrize("where", WHERE)
def test_page_locking_without_cuda_says_so(where) -> None:
    if torch.cuda.is_available():
        with where("MortarMayhem-v0", 4, pin_memory=True) as envs:
            observation = envs.reset()[0]
            assert torch.equal(endless_gym.torch_view(observation).to("cuda").cpu(), torch.tensor(observation))
        return
    with pytest.warns(UserWarning, match="no CUDA device"), where("MortarMayhem-v0", 4, pin_memory=True) as envs:
        assert envs.reset()[0].any()


@pytest.mark.parametrize("where", WHERE)
def test_without_torch_the_message_says_so(where, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.warns(UserWarning, match="not installed"):
        where("MortarMayhem-v0", 4, pin_memory=True).close()


@pytest.mark.parametrize("where", WHERE)
def test_copies_are_not_page_locked(where) -> None:
    with pytest.raises(ValueError, match="copy=True copies out of it; omit one"):
        where("MortarMayhem-v0", 4, pin_memory=True, copy=True)


class Cuda:
    """CUDA's registration of memory; `calls` are addresses and sizes, negative for the end, and devices that were waited for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, accepted: int | None = 8) -> None:
        self.calls: list[tuple[int, int] | str] = []
        self._accepted = accepted
        self._mappings: dict[int, tuple[int, int]] = {}
        replaced = {
            "is_available": lambda: True,
            "cudart": lambda: self,
            "device_count": lambda: 3,
            "memory_reserved": lambda device: int(device != 1),
            "synchronize": lambda device: self.calls.append(f"waited for {device}"),
        }
        for name, function in replaced.items():
            monkeypatch.setattr(torch.cuda, name, function)

    def cudaHostRegister(self, first: int, size: int, flags: int) -> int:
        assert first % 4096 == size % 4096 == 0
        if flags != self._accepted:
            return 801
        self._mappings[first] = interop.mapping_of(first)
        self.calls.append((first, size))
        return 0

    def cudaHostUnregister(self, first: int) -> int:
        # It is still mapped.
        assert interop.mapping_of(first) == self._mappings.pop(first)
        self.calls.append((-first, 0))
        return 0

    def holds(self, array: np.ndarray) -> bool:
        """Whether the array's memory is page-locked."""
        address, size = array.ctypes.data, array.nbytes
        return any(first <= address and address + size <= end for first, end in self.spans())

    def spans(self) -> list[tuple[int, int]]:
        return [(first, first + size) for first, size in self._mappings.values()]


@pytest.mark.parametrize("flags", [8, 0])
def test_the_memory_of_each_group_is_page_locked_once(flags: int, monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = Cuda(monkeypatch, flags)
    arguments = {"num_envs": 2, "groups": 2, "seed": 1}
    with endless_gym.serve(ENDLESS, batches_held=1, pin_memory=True, **arguments) as envs:
        with endless_gym.make_vec(ENDLESS, **arguments) as twin:
            for _ in range(2):
                for group in range(2):
                    np.testing.assert_array_equal(envs.reset(group=group)[0], twin.reset(group=group)[0])
                    for _ in range(6):
                        envs.send(np.ones((2, 2), np.int64), group)
                        twin.send(np.ones((2, 2), np.int64), group)
                        observation = envs.recv(group)[0]
                        assert cuda.holds(observation)
                        np.testing.assert_array_equal(observation, twin.recv(group)[0])
                        del observation
                    envs.adopt(group)
        observation = envs.reset()[0]
        kept = observation.copy()
        assert len(cuda.calls) == len(cuda.spans()) == 2
    firsts = [first for first, _ in cuda.calls[:2]]
    assert cuda.calls[2:] == ["waited for 0", "waited for 2", *((-first, 0) for first in firsts)]
    np.testing.assert_array_equal(observation, kept)


def test_the_memory_of_a_replaced_engine_is_unlocked(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = Cuda(monkeypatch)
    with engine_of_program("pinned", ENDLESS, "--num-envs=2") as first:
        envs = endless_gym.connect("pinned", pin_memory=True)
        assert cuda.holds(envs.reset(seed=1)[0])
        first.kill()
        first.wait()
    with pytest.raises(endless_gym.EngineLost):
        envs.step(np.ones((2, 2), np.int64))
    with engine_of_program("pinned", ENDLESS, "--num-envs=2"):
        envs.reconnect()
        assert cuda.spans() == []
        assert cuda.holds(envs.reset(seed=1)[0])
        # The results of the same engine remain, and their memory is locked again.
        assert not envs.reconnect().restarted
        assert cuda.spans() == []
        assert cuda.holds(envs.step(np.ones((2, 2), np.int64))[0])
        envs.close()
    assert cuda.spans() == []


def test_an_engine_must_lend_more_than_the_batch_that_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    Cuda(monkeypatch)
    with engine_of_program("one", ENDLESS, "--batches-held=1"):
        with pytest.raises(ValueError, match="the engine lends 1; start it with 2 or more batches held"):
            endless_gym.connect("one", pin_memory=True)
        endless_gym.connect("one").close()


def test_memory_that_cuda_refuses_is_used_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda, allocate, consumed = Cuda(monkeypatch, accepted=None), torch.zeros, []

    def zeros(*args: object, **kwargs: object) -> torch.Tensor:
        if kwargs.get("device") == "cuda":
            consumed.append(args)
            raise RuntimeError("CUDA error: operation not supported")
        return allocate(*args, **kwargs)

    monkeypatch.setattr(torch, "zeros", zeros)
    with endless_gym.serve(ENDLESS, 2, pin_memory=True) as envs:
        with pytest.warns(UserWarning, match=r"memory is not page-locked: CUDA refuses \d+ bytes, with error 801"):
            assert envs.reset()[0].any()
        assert consumed == [(1,)]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert envs.step(np.ones((2, 2), np.int64))[0].any()
    assert cuda.calls == []


def test_environments_in_this_process_write_to_memory_of_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    Cuda(monkeypatch)
    allocate, tensors = torch.zeros, []

    def zeros(size: int, *, dtype: torch.dtype, pin_memory: bool) -> torch.Tensor:
        assert pin_memory
        tensors.append(allocate(size, dtype=dtype))
        return tensors[-1]

    monkeypatch.setattr(torch, "zeros", zeros)
    arguments = {"num_envs": 3, "groups": 2, "seed": 2, "observation": "rgb+features", "autoreset": "same_step"}
    with endless_gym.make_vec(ENDLESS, **arguments) as twin:
        with endless_gym.make_vec(ENDLESS, pin_memory=True, **arguments) as envs:
            held = []
            for group in range(2):
                same(envs.reset(group=group), twin.reset(group=group))
                for step in range(40):
                    for each in (envs, twin):
                        each.send(np.full((3, 2), step % 3), group)
                    stepped = envs.recv(group)
                    same(stepped, twin.recv(group))
                    for array in (*stepped[0].values(), stepped[4]["ground_truth"]):
                        assert any(
                            0 <= array.ctypes.data - tensor.data_ptr() <= tensor.nbytes - array.nbytes
                            for tensor in tensors
                        )
                    # As in other memory, arrays of the user stay as they are.
                    if step < 3:
                        held.append((stepped[0]["visual_observation"], stepped[0]["visual_observation"].copy()))
        assert len(tensors) <= 2 * (3 + 2)
    del tensors[:], stepped, array
    for observation, kept in held:
        np.testing.assert_array_equal(observation, kept)


def test_unfit_memory_is_refused() -> None:
    given = checked_arguments(ENDLESS, 2, 1, 1, 1, None, None, "same_step", "rgb", None, False, False, 0, None)
    unfit = {
        ValueError: [
            lambda size: torch.zeros(size - 1, dtype=torch.uint8),
            lambda size: torch.zeros(size + 1, dtype=torch.uint8)[1:],
            lambda size: torch.zeros(2 * size, dtype=torch.uint8)[::2],
        ],
        TypeError: [lambda size: torch.zeros(size), lambda size: torch.zeros(1, size, dtype=torch.uint8)],
    }
    for error, allocations in unfit.items():
        for allocate in allocations:
            pools = endless_gym._native.Pools([json_text(given.pools[0])], 1, allocate)
            with pytest.raises(error):
                pools.reset(0)


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
