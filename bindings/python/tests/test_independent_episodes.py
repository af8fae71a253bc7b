"""`independent_episodes` reaches the environments, however they are made."""

import gymnasium
import pytest
from support import engine_of_program, exact

import endless_gym

ID = "Endless-MortarMayhem-v0"
#: Affects later episodes.
LEFT = {"agent_scale": 0.4}


def played(envs, seed: int, options: dict, steps: int) -> list[object]:
    """Everything that an environment or a vector environment returns for a seed and the same actions, as `exact` values."""
    envs.action_space.seed(seed)
    out = [exact(envs.reset(seed=seed, options=options))]
    for _ in range(steps):
        step = envs.step(envs.action_space.sample())
        out.append(exact(step))
        if isinstance(envs, gymnasium.Env) and step[2]:
            out.append(exact(envs.reset()))
    return out


@pytest.mark.parametrize("independent", [False, True])
def test_used_environments_play_like_new_ones_only_with_the_argument(independent: bool) -> None:
    used, new = (gymnasium.make(f"EndlessGym/{ID}", independent_episodes=independent) for _ in range(2))
    played(used, 3, LEFT, 70)
    assert (played(used, 11, {}, 150) == played(new, 11, {}, 150)) is independent


def test_the_program_serves_independent_episodes() -> None:
    with engine_of_program("independent", ID, "--num-envs=2", "--independent-episodes"):
        with endless_gym.connect("independent") as envs:
            played(envs, 3, LEFT, 70)
            used = played(envs, 11, {}, 100)
        with endless_gym.make_vec(ID, 2, independent_episodes=True) as envs:
            assert used == played(envs, 11, {}, 100)


def test_a_checkpoint_of_dependent_episodes_is_refused(tmp_path) -> None:
    file = tmp_path / "state"
    with endless_gym.serve("MysteryPath-v0", 2, seed=1, checkpoint=file) as envs:
        envs.reset()
    with pytest.raises(RuntimeError, match="continued generators"):
        endless_gym.serve("MysteryPath-v0", 2, seed=1, checkpoint=file, resume=True, independent_episodes=True)
    with endless_gym.serve("MysteryPath-v0", 2, seed=1, checkpoint=file, resume=True) as envs:
        envs.adopt()
