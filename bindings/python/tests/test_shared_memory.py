"""Nothing that a user does with the arrays of a step changes later steps or kills the process."""

import gc
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import endless_gym

torch = pytest.importorskip("torch")
writes = pytest.importorskip("shared_memory_writes")
pytestmark = pytest.mark.libraries

EXPORTS = [writes.imported, lambda array: torch.from_dlpack(endless_gym.DLPackView(array))]
FRAMES = [None, endless_gym.Frames(grayscale=True, stack=2), endless_gym.Frames(channels_first=True, row_major=True)]


def arrays_of(returned: object) -> list[np.ndarray]:
    """All arrays in what `step` or `reset` returned, except times."""
    if isinstance(returned, dict):
        return [array for key, value in returned.items() if key != "t" for array in arrays_of(value)]
    if isinstance(returned, tuple):
        return [array for value in returned for array in arrays_of(value)]
    return [returned] if isinstance(returned, np.ndarray) and returned.dtype != object else []


@pytest.mark.parametrize("export", EXPORTS)
@pytest.mark.parametrize("frames", FRAMES)
@pytest.mark.parametrize("id", ["MortarMayhemB-v0", "Endless-MysteryPath-v0", "SearingSpotlights-v0"])
def test_later_frames_overwrite_writes_to_exported_memory(
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


def test_reading_without_an_export_causes_no_full_redraw() -> None:
    """Ways to read that do not export a writable tensor cause no full redraw, so a pixel changed behind the engine stays."""
    with endless_gym.make_vec("MortarMayhem-Grid-v0", 1, seed=5, autoreset="disabled") as envs:
        envs.reset()
        for _ in range(3):
            observation = envs.step([0])[0]
            endless_gym.torch_view(observation).float().sum()
            np.from_dlpack(endless_gym.DLPackView(observation)).sum()
        address = observation.ctypes.data
        corner = endless_gym.torch_view(observation)[0, 83, 83]
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
    assert int(ran.stdout) == 3 * len(writes.array_writes())


def test_refused_exports_say_how_to_export() -> None:
    with endless_gym.serve("MortarMayhem-v0", 2) as envs:
        observation, _ = envs.reset()
        with pytest.raises(BufferError, match=r"export a copy: array.copy\(\)"):
            endless_gym.DLPackView(observation).__dlpack__()
        with pytest.raises(BufferError, match="read-only flag"):
            endless_gym.DLPackView(observation).__dlpack__(max_version=(0, 8))
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


def test_an_unconsumed_capsule_releases_the_array() -> None:
    with endless_gym.make_vec("MortarMayhem-v0", 2) as envs:
        observation, _ = envs.reset()
        address = observation.ctypes.data
        endless_gym.DLPackView(observation).__dlpack__(max_version=(1, 0))
        endless_gym.DLPackView(observation).__dlpack__()
        del observation
        assert address in {envs.step(np.ones((2, 2), np.int64))[0].ctypes.data for _ in range(3)}
