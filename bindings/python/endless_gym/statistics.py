"""Statistics of episodes in `info["episode"]`, where scripts in the style of CleanRL look for them."""

from __future__ import annotations

from typing import Any

import gymnasium.wrappers.vector

from endless_gym.requests.configuration import AutoresetMode


class RecordEpisodeStatistics(gymnasium.wrappers.vector.RecordEpisodeStatistics):
    """Gymnasium's wrapper, whose statistics are right in every auto-reset mode and version of Gymnasium.

    Steps that end episodes have `info["episode"]`: return `r`, length `l` and seconds `t` of each episode that ended, (n,) each,
    with the mask `info["_episode"]`. Under Gymnasium 1.1 to 1.3, the original wrapper misses the first step of every episode
    after the first with same-step auto-reset.
    """

    def step(self, actions: Any) -> Any:
        if self.env.metadata.get("autoreset_mode") is AutoresetMode.SAME_STEP:
            # These versions take the step after an end for a reset. Start the new episodes here, so that they count it.
            for name in ("episode_returns", "episode_lengths"):
                getattr(self, name)[self.prev_dones] = 0
            self.prev_dones[:] = False
        return super().step(actions)
