"""TorchRL's collector in several processes, each with its own engine."""

import os

import numpy as np
import pytest
from support import segments

import endless_gym

psutil = pytest.importorskip("psutil")
torch = pytest.importorskip("torch")
MultiCollector = pytest.importorskip("torchrl.collectors").MultiCollector
EndlessEnv = pytest.importorskip("endless_gym.torchrl").EndlessEnv
pytestmark = pytest.mark.libraries

ID, ENVS, WORKERS, STEPS = "MysteryPath-Grid-v0", 6, 2, 12


def test_environments_must_be_divisible_among_the_workers() -> None:
    with pytest.raises(ValueError, match="multiple of num_workers, got 6 environments and 4 workers"):
        EndlessEnv.workers(ID, 6, 4)
    with pytest.raises(ValueError, match="multiple of num_workers, got 6 environments and 0 workers"):
        EndlessEnv.workers(ID, 6, 0)


@pytest.mark.slow
def test_workers_play_the_same_episodes_as_one_process() -> None:
    """Each worker plays its share of the episodes of one process: no seed is used twice, and none is left out."""
    makers = EndlessEnv.workers(ID, ENVS, WORKERS, seed=40, options={"max_steps": 5})
    collector = MultiCollector(
        makers, None, sync=True, cat_results=0, frames_per_batch=ENVS * STEPS, total_frames=2 * ENVS * STEPS
    )
    try:
        batches = [batch.clone() for batch in collector]
        assert segments(), "the frames come from engines"
        processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    finally:
        collector.shutdown()
    data = torch.cat(batches, 1)
    assert tuple(data.batch_size) == (ENVS, 2 * STEPS)

    with endless_gym.make_vec(ID, num_envs=ENVS, autoreset="disabled", seed=40, options={"max_steps": 5}) as envs:
        observation, _ = envs.reset()
        assert len({frame.tobytes() for frame in observation}) > 1, "different seeds look different"
        ended = 0
        for step in range(2 * STEPS):
            np.testing.assert_array_equal(data["observation"][:, step], observation)
            observation, reward, terminated, truncated, _ = envs.step(data["action"][:, step].numpy())
            np.testing.assert_array_equal(data["next", "observation"][:, step], observation)
            np.testing.assert_allclose(data["next", "reward"][:, step, 0], reward)
            over = terminated | truncated
            np.testing.assert_array_equal(data["next", "done"][:, step, 0], over)
            ended += int(over.sum())
            if over.any():
                observation, _ = envs.reset(options={"reset_mask": over})
        assert ended >= ENVS, "later episodes were compared, too"
    assert not segments()
    tensors = tuple(f"torch_{process.pid}_" for process in processes)
    assert not [name for name in os.listdir("/dev/shm") if name.startswith(tensors)]
