"""Compares the statistics of episodes with the engine's, under any version of Gymnasium that has vector environments.

Prints the version of Gymnasium, and the numbers of episodes and of those whose statistics Gymnasium's own wrapper gets wrong.
"""

import gymnasium
import numpy as np

import endless_gym


def compare(autoreset: str) -> tuple[int, int]:
    """Plays random steps; returns the numbers of episodes and of wrong ones."""
    made = [endless_gym.make_vec("Endless-MortarMayhem-v0", 8, seed=1, autoreset=autoreset) for _ in range(2)]
    ours = endless_gym.RecordEpisodeStatistics(made[0])
    theirs = gymnasium.wrappers.vector.RecordEpisodeStatistics(made[1])
    actions = np.random.default_rng(1)
    ended = wrong = 0
    for envs in (ours, theirs):
        envs.reset(seed=1)
    for _ in range(400):
        given = actions.integers(0, 3, (8, 2))
        info, other = ours.step(given)[4], theirs.step(given)[4]
        final = info.get("final_info", info)
        assert ("episode" in info) == ("reward" in final)
        if "episode" not in info:
            continue
        mask = info["_episode"]
        np.testing.assert_array_equal(mask, final["_reward"])
        np.testing.assert_array_equal(info["episode"]["l"][mask], final["length"][mask])
        np.testing.assert_allclose(info["episode"]["r"][mask], final["reward"][mask], rtol=0, atol=1e-5)
        assert (info["episode"]["t"][mask] >= 0).all()
        ended += int(mask.sum())
        wrong += int((other["episode"]["l"][mask] != final["length"][mask]).sum())
    assert list(ours.length_queue)[-1] > 0 and ours.episode_count == ended
    return ended, wrong


if __name__ == "__main__":
    print(gymnasium.__version__, *compare("same_step"), *compare("next_step"))
