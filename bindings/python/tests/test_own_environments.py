"""Environments of other native modules than the package's own. `test_own_crate.py` builds a real one."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType

import gymnasium
import pytest

import endless_gym
from endless_gym import _native


def module(name: str, id: str, version: str = _native.__version__) -> ModuleType:
    """A native module with one environment, played by the package's own module under another id."""
    made = ModuleType(name)
    described = {**json.loads(_native.specs())[0], "id": id}
    made.__version__, made.specs = version, lambda: json.dumps([described])
    return made


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The native module of an imported package `mine`."""
    native = module("mine._native", "Mine-v0")
    monkeypatch.setitem(sys.modules, "mine", ModuleType("mine"))
    monkeypatch.setitem(sys.modules, "mine._native", native)
    monkeypatch.setattr(endless_gym.specs, "_SPECS", dict(endless_gym.all_specs()))
    yield native
    gymnasium.registry.pop("EndlessGym/Mine-v0", None)


def test_an_id_is_found_with_and_without_its_package(package):
    endless_gym.register_envs(package)
    endless_gym.register_envs(package)
    found = endless_gym.spec("Mine-v0")
    assert endless_gym.spec("mine:Mine-v0") is endless_gym.spec("mine:EndlessGym/Mine-v0") is found
    assert found.native is package
    assert found.full_id == "mine:Mine-v0"
    assert endless_gym.spec(found.full_id) is found
    assert gymnasium.spec("EndlessGym/Mine-v0").kwargs == {"env_id": "mine:Mine-v0"}


def test_unknown_packages_and_ids_are_errors_that_name_them(package):
    with pytest.raises(ValueError, match="'nowhere:Mine-v0': No module named 'nowhere'"):
        endless_gym.make_vec("nowhere:Mine-v0")
    with pytest.raises(ValueError, match=r"must be one of MortarMayhem-v0, .*, got 'mine:Mine-v0'"):
        endless_gym.make_vec("mine:Mine-v0")


def test_an_id_of_two_modules_is_an_error_that_names_both(package):
    endless_gym.register_envs(package)
    message = r"^other._native must not have the id Mine-v0, which mine._native has already$"
    with pytest.raises(ValueError, match=message):
        endless_gym.register_envs(module("other._native", "Mine-v0"))
    with pytest.raises(ValueError, match=r"MysteryPath-v0, which endless_gym\._native has already"):
        endless_gym.register_envs(module("other._native", "MysteryPath-v0"))
    assert endless_gym.spec("Mine-v0").native is package


def test_a_module_of_another_version_or_kind_is_refused(package):
    with pytest.raises(ValueError, match=f"built with endless-gym-python 9.9.9, .* {_native.__version__}"):
        endless_gym.register_envs(module("old._native", "Old-v0", "9.9.9"))
    with pytest.raises(TypeError, match=r"must be a native module .* got <module 'json'"):
        endless_gym.register_envs(json)
    assert "Old-v0" not in endless_gym.all_specs()


def test_exceptions_of_engines_are_those_of_the_package():
    assert endless_gym.EngineLost.__module__ == endless_gym.TooManyBatchesHeld.__module__ == "endless_gym"
    assert not hasattr(_native, "EngineLost")


def test_step_limits_are_those_of_the_native_module():
    found = endless_gym.spec("MysteryPath-v0")
    assert found.max_episode_steps({"max_steps": 7}) == 7
    assert found.max_episode_steps({"max_steps": 0}) == -1
    assert endless_gym.spec("MortarMayhem-v0").max_episode_steps({"command_count": [2, 3]}) == 79
    with pytest.raises(ValueError, match=r"reset parameter `max_steps` must be an integer, got 0\.5"):
        found.max_episode_steps({"max_steps": 0.5})
    # An engine of another build plays it.
    assert replace(found, id="Unknown-v0").max_episode_steps({"max_steps": 7}) == -1
