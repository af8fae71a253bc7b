"""The meanings of actions, ground truth and features are the same wherever a user looks."""

import json
import pydoc
import subprocess
import sys

import gymnasium
import pytest
from support import MEMORY_GYM

import endless_gym


@pytest.mark.parametrize("id", MEMORY_GYM)
def test_every_number_has_a_name_and_a_meaning(id: str) -> None:
    spec = endless_gym.spec(id)
    assert tuple(len(branch.choices) for branch in spec.actions) == spec.branches
    env = gymnasium.make(f"EndlessGym/{id}")
    with endless_gym.make_vec(id, 1) as envs:
        for metadata in (env.metadata, envs.metadata):
            assert [len(names) for names in metadata["actions"].values()] == list(spec.branches)
            assert len(metadata["ground_truth"]) == spec.ground_truth
            assert len(metadata["features"]) == len(spec.features)
            json.dumps([metadata[name] for name in ("actions", "ground_truth", "features")])


@pytest.mark.parametrize("shown", [endless_gym.Env, endless_gym.Env(MEMORY_GYM[0]), endless_gym.EndlessVectorEnv])
def test_help_shows_actions_and_ground_truth(shown: object) -> None:
    page = pydoc.plain(pydoc.render_doc(shown))
    assert "action[0], horizontal: 0 nothing, 1 left, 2 right" in page
    assert "action: 0 nothing, 1 left, 2 right, 3 ahead" in page
    assert 'info["ground_truth"][0], target_x: column of the tile' in page
    assert all(id in page for id in MEMORY_GYM)


def test_a_package_without_docstrings_can_be_imported() -> None:
    text = "import endless_gym; endless_gym.Env('MysteryPath-v0'); print(endless_gym.Env.__doc__)"
    ran = subprocess.run([sys.executable, "-OO", "-c", text], capture_output=True, text=True)
    assert ran.stdout == "None\n", ran.stderr
