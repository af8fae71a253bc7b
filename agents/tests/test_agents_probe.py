"""Probes of an agent's memory: synthetic memories with and without the answer, and a real agent's."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from agents_helpers import saved, settings

from endless_gym_agents.evaluation import probe
from endless_gym_agents.evaluation.probe import Recording, Score

ID = "Endless-MysteryPath-v0"


def synthetic(linear: bool) -> dict[tuple[str, str, str], Score]:
    """Scores where the memory contains the truth, linearly or as a product of signs, and the observation is noise."""
    generator = torch.Generator().manual_seed(1)
    episode = torch.arange(60).repeat_interleave(50)
    memory = torch.randn(len(episode), 8, generator=generator)
    bit = ((memory[:, 0] > 0) == (memory[:, 1] > 0)).float()
    truth = torch.stack([memory[:, :3].sum(-1) if linear else bit, (memory[:, 4] > 0).float()], dim=-1)
    noise = torch.randn(len(episode), 8, generator=generator)
    scores = probe.probe(Recording(memory, noise, truth, episode), ["a", "b"])
    assert len(scores) == 8
    return {(score.column, score.source, score.probe): score for score in scores}


def test_a_linear_memory_is_read_by_both_probes_and_noise_by_none() -> None:
    scores = synthetic(linear=True)
    assert scores["a", "memory", "linear"].explained > 0.99
    assert scores["a", "memory", "mlp"].explained > 0.95
    assert scores["a", "memory", "linear"].accuracy is None
    sign = scores["b", "memory", "linear"]
    assert sign.accuracy is not None
    assert sign.majority is not None
    assert sign.accuracy > 0.95 > 0.6 > sign.majority
    for name in ("a", "b"):
        for kind in ("linear", "mlp"):
            assert scores[name, "observation", kind].explained < 0.05
    guess = scores["b", "observation", "linear"].accuracy
    assert guess is not None
    assert 0.4 < guess < 0.6


def test_only_the_nonlinear_probe_reads_a_nonlinear_memory() -> None:
    scores = synthetic(linear=False)
    assert scores["a", "memory", "linear"].explained < 0.05
    assert scores["a", "memory", "mlp"].explained > 0.6


@pytest.mark.parametrize("agent", ["gru", "trxl", "none"])
def test_recording_contains_the_inputs_of_the_heads(agent: str, tmp_path: Path) -> None:
    """The value head applied to the recorded memory gives the values of acting; recording does not change the agent."""
    made = saved(tmp_path, settings(agent, env=ID))
    before = {name: value.clone() for name, value in made.state_dict().items()}
    values, act = [], made.act

    def acting(*arguments, **named):
        output = act(*arguments, **named)
        values.append(output.value)
        return output

    made.act = acting
    recorded = probe.record(made, range(200_000, 200_004), max_steps=10)
    # Until the first episode ends, every step has all environments.
    steps = len(values) if len(recorded.episode) == 4 * len(values) else int((recorded.episode.bincount()).min())
    assert steps > 1
    with torch.no_grad():
        again = made.value(made.body(recorded.memory[: 4 * steps]))
    torch.testing.assert_close(again, torch.cat(values[:steps]), rtol=1e-4, atol=1e-5)
    assert recorded.truth.shape == (len(recorded.episode), 3)
    assert set(recorded.truth.unique().tolist()) <= {0.0, 1.0}
    assert all(torch.equal(before[name], value) for name, value in made.state_dict().items())


def test_the_command_and_its_errors(
    tmp_path: Path, call: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    for env in (ID, "MortarMayhem-Grid-v0"):
        saved(tmp_path / env, settings("gru", env=env))
    assert call(probe.main, tmp_path / ID, "--episodes", 5, "--max-steps", 20, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [score["column"] for score in found["scores"][:3]] == ["right", "up", "down"]
    assert found["steps"] <= 100
    for changed, message in (
        (["--episodes", "1"], "--episodes must be 2 or more, got 1"),
        ([], "a probe needs a ground truth, and MortarMayhem-Grid-v0 has none"),
    ):
        assert call(probe.main, tmp_path / "MortarMayhem-Grid-v0", *changed) == 1
        assert message in capsys.readouterr().err
