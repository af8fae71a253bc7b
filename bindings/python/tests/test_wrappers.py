"""Every wrapper of Gymnasium works with single and vector environments, in process and served, also when episodes end."""

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from support import same
from wrappers import SHORT, SINGLE, VECTOR, Case, Refuses, plain, recorded, torch

import endless_gym

__all__ = ["recorded"]

#: An id with dict observations.
DICT_ID = "MortarMayhemB-v0"
#: The wrappers that convert to tensors, which need the packages of the group `libraries`.
TENSORS = ("ArrayConversion", "NumpyToTorch")
WHERE = {"in process": endless_gym.make_vec, "served": endless_gym.serve}
NUM_ENVS = 3
STEPS = 9


def marked(cases: dict[str, Case | Refuses | str]) -> list[Any]:
    """The names of wrappers that apply or refuse; a text says why there is nothing to test."""
    names = [name for name, case in cases.items() if not isinstance(case, str)]
    return [pytest.param(name, marks=pytest.mark.libraries) if name in TENSORS else name for name in names]


def is_dict(id: str) -> bool:
    return endless_gym.spec(id).vector_observation > 0


def test_every_wrapper_of_gymnasium_is_listed() -> None:
    assert set(SINGLE) == set(gymnasium.wrappers.__all__) - {"vector"}
    assert set(VECTOR) == set(gymnasium.wrappers.vector.__all__)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", marked(SINGLE))
@pytest.mark.parametrize("id", ["Endless-MortarMayhem-v0", "MysteryPath-Grid-v0", DICT_ID])
def test_wrappers_work_with_single_environments(name: str, id: str, recorded: list[Any]) -> None:
    case = SINGLE[name]
    assert not isinstance(case, str)
    kwargs = {} if isinstance(case, Refuses) else case.kwargs
    env = gymnasium.make(f"EndlessGym/{id}", options=SHORT[id], **kwargs)
    if isinstance(case, Refuses):
        with pytest.raises(case.error, match=case.match):
            case.wrap(env)
        return
    if is_dict(id) not in case.dicts:
        pytest.skip("the wrapper is for other observations")
    wrapped = case.wrap(env)
    wrapped.action_space.seed(1)
    observation, _ = wrapped.reset(seed=1)
    episodes = 0
    for _ in range(STEPS):
        if name not in TENSORS:
            assert observation in wrapped.observation_space
        action = wrapped.action_space.sample()
        if name in TENSORS:
            action = torch.as_tensor(action)
        observation, reward, terminated, truncated, info = wrapped.step(action)
        assert np.isfinite(reward)
        if name == "RecordEpisodeStatistics" and terminated:
            assert (info["episode"]["r"], info["episode"]["l"]) == (info["reward"], info["length"])
        if terminated or truncated:
            episodes += 1
            observation, _ = wrapped.reset()
    assert episodes > 0
    if wrapped.render_mode not in (None, "human"):
        wrapped.render()
    wrapped.close()
    if name == "RecordVideo":
        assert len(recorded) > 0


#: Dict observations, and frames with two action branches and with one: in process in all modes, served in one mode each.
KINDS = (DICT_ID, "SearingSpotlights-v0", "Endless-MysteryPath-v0")
PAIRS = [
    *(("in process", mode, id) for mode in AutoresetMode for id in KINDS),
    *(("served", mode, id) for mode, id in zip(AutoresetMode, KINDS, strict=True)),
]


@pytest.fixture(scope="module", params=PAIRS, ids=lambda each: f"{each[0]}, {each[1].name}, {each[2]}")
def pair(request: pytest.FixtureRequest) -> Iterator[tuple[VectorEnv, VectorEnv]]:
    """Our vector environments and Gymnasium's. Both always play the same, so that an episode shows the same traces of earlier
    ones."""
    where, mode, id = request.param
    with WHERE[where](id, NUM_ENVS, autoreset=mode, options=SHORT[id], render_mode="rgb_array") as envs:
        sync = synchronous(id, mode)
        assert envs.single_observation_space == sync.single_observation_space
        assert envs.action_space == sync.action_space
        yield envs, sync


def synchronous(id: str, mode: AutoresetMode) -> VectorEnv:
    make = lambda: endless_gym.Env(id, "rgb_array", SHORT[id])  # noqa: E731
    return SyncVectorEnv([make] * NUM_ENVS, autoreset_mode=mode)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", marked(VECTOR))
def test_wrappers_return_the_same_as_over_sync_vector_env(
    name: str, pair: tuple[Any, Any], recorded: list[Any]
) -> None:
    case, (envs, sync) = VECTOR[name], pair
    assert not isinstance(case, str)
    if isinstance(case, Refuses):
        for each in pair:
            with pytest.raises(case.error, match=case.match):
                case.wrap(each)
        return
    if (isinstance(envs.single_observation_space, gymnasium.spaces.Dict)) not in case.dicts:
        pytest.skip("the wrapper is for other observations")
    if envs.metadata["autoreset_mode"] not in case.modes:
        for each in pair:
            with pytest.raises((ValueError, BufferError), match=r"autoreset_mode|DLPack only supports"):
                play(case, each, name)
        return
    given, wanted = play(case, envs, name), play(case, sync, name)
    same(given, wanted, name)
    if name == "RecordVideo":
        ours, theirs = recorded[: len(recorded) // 2], recorded[len(recorded) // 2 :]
        assert len(ours) > 0
        same(plain(ours), plain(theirs), name)


def play(case: Case, envs: VectorEnv, name: str) -> Any:
    """Everything that a wrapper returns; the environments are not closed."""
    wrapped = case.wrap(envs)
    envs.action_space.seed(1)
    disabled = envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    returned, ends = [plain(wrapped.reset(seed=7))], 0
    for _ in range(STEPS):
        actions = envs.action_space.sample()
        step = wrapped.step(torch.as_tensor(actions) if name in TENSORS else actions)
        returned.append(plain(step))
        done = np.asarray(step[2]) | np.asarray(step[3])
        ends += int(done.sum())
        if disabled and done.any():
            # Wrappers that convert arrays cannot reset single environments.
            returned.append(plain(envs.reset(options={"reset_mask": done})))
    assert ends > NUM_ENVS
    if getattr(wrapped, "recording", False):
        wrapped.stop_recording()
    return returned


@pytest.mark.parametrize("where", WHERE.values(), ids=WHERE)
def test_rewards_and_flags_are_writable_copies(where: Any) -> None:
    with where("MortarMayhem-Grid-v0", 2, seed=1) as envs:
        envs.reset()
        kept = [envs.step(np.ones(2, np.int64)) for _ in range(3)]
        for observation, *numbers, info in kept:
            assert not observation.flags.writeable
            for array, dtype in zip(numbers, (np.float64, np.bool_, np.bool_), strict=True):
                assert array.flags.writeable and array.flags.owndata and array.dtype == dtype and array.shape == (2,)
                array[:] = 1
            del info
        envs.reset(seed=1)
        _, reward, terminated, truncated, _ = envs.step(np.ones(2, np.int64))
        assert not reward.any() and not terminated.any() and not truncated.any()
