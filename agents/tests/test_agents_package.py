"""What works without the package's extras."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from agents_helpers import saved, settings

from endless_gym_agents.evaluation import compare, plot
from endless_gym_agents.paper import reproduce, search
from endless_gym_agents.training import train

#: Plays two episodes with the agent of a run, without the packages of the extras.
ACTS = """
import sys
for name in ("matplotlib", "optuna", "ray", "tensorboard"):
    sys.modules[name] = None
import endless_gym_agents
from endless_gym_agents.evaluate import evaluate
print(*(sorted(episode) for episode in evaluate(endless_gym_agents.load(sys.argv[1]).agent, range(2), 1)))
"""


def test_an_agent_loads_and_acts_without_the_extras(tmp_path: Path) -> None:
    saved(tmp_path / "run", settings("gru", env="MortarMayhem-Grid-v0"))
    ran = subprocess.run([sys.executable, "-c", ACTS, tmp_path / "run"], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.count("'reward'") == 2


@pytest.mark.parametrize(
    ("main", "given", "message"),
    [
        (train.main, "--env MortarMayhem-Grid-v0 --ppo.updates 1", "training needs tensorboard"),
        (plot.main, "--env MortarMayhem-v0", "a plot needs matplotlib"),
        (compare.main, "results.json", "a comparison needs matplotlib"),
        (search.main, "--env MortarMayhem-Grid-v0", "the search needs optuna"),
        (reproduce.main, "endless", "endless-reproduce needs tensorboard"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(
    main: Callable[[], int],
    given: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    call: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("matplotlib", "optuna", "tensorboard"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.chdir(tmp_path)
    assert call(main, *given.split()) == 1
    assert f"{message}, which is not installed: pip install './agents[train]'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
