"""Runs of `endless learn`, the trainer in Rust: the same numbers as those of the Python agents, which read them."""

import json
import re
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
import torch
from agents_helpers import documented_settings
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn import functional

from endless_gym.specs import all_specs
from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.common.clock import Clock
from endless_gym_agents.common.command import STOP_SIGNALS
from endless_gym_agents.environments.groups import Environments
from endless_gym_agents.evaluation import export, plot, protocol, record
from endless_gym_agents.evaluation.evaluate import evaluate
from endless_gym_agents.settings import (
    ONE_HOT,
    PAPER_STEPS_PER_UPDATE,
    PRESETS,
    VECTORS,
    Settings,
    paper_run_length,
    value,
)
from endless_gym_agents.training import checkpoint, ppo
from endless_gym_agents.training.logs import read_progress
from endless_gym_agents.training.rollout import RolloutCollector
from endless_gym_agents.training.run_folder import RunInUse, locked
from endless_gym_agents.training.train import parse, train

#: A segment, and so a minibatch, of one step.
ONE_STEP = "--environment.num-envs 1 --ppo.steps 1 --recurrence.sequence-length 1"
GRID = "MortarMayhem-Grid-v0 --environment.option command_count=[1]"
FLAGS = "--environment.num-envs 8 --ppo.steps 16 --recurrence.sequence-length 8 "
FLAGS += "--recurrence.hidden-size 16 --model.head-width 8 --ppo.minibatches 1 --no-stop-when-learnt --keep-checkpoints"
ENDLESS = [sys.executable, "-c", "import sys; from endless_gym.cli import main; sys.exit(main())"]
PROGRAM = [*ENDLESS, "learn"]


def learn(arguments: str, fails: bool = False) -> str:
    """Run `endless learn`, and return what it printed."""
    result = subprocess.run([*PROGRAM, *arguments.split()], capture_output=True, text=True, timeout=120)
    assert result.returncode == fails, result.stderr
    return result.stderr if fails else result.stdout


def new_run(run: Path, flags: str, env: str = GRID) -> Path:
    learn(f"{env} {FLAGS} --run {run} {flags}")
    return run


def numbered(run: Path, update: int) -> checkpoint.Checkpoint:
    return checkpoint.load(run / "checkpoints" / f"update-{update:06d}.safetensors")


def noise_of(seed: int, update: int, shape: tuple[int, ...], branches: Sequence[int]) -> Tensor:
    """The Gumbel noise of an update, from the same uniform numbers, (*shape, branches, choices)."""
    sequence = np.random.SeedSequence(seed, spawn_key=(1, update))
    uniform = np.random.Generator(np.random.PCG64(sequence)).random((*shape, sum(branches)), dtype=np.float32)
    noise = torch.from_numpy(-np.log(-np.log(np.maximum(uniform, np.finfo(np.float32).tiny))))
    parts = [functional.pad(part, (0, max(branches) - part.shape[-1])) for part in noise.split(list(branches), -1)]
    return torch.stack(parts, -2)


@pytest.mark.parametrize(
    "flags",
    [
        "popgym-AutoencodeEasy-v0",
        "popgym-CountRecallEasy-v0",
        "--agent gru --recurrence.layers 2 --recurrence.residual",
        "--agent gru --ppo.advantage-normalisation none --recurrence.no-embedding",
        "--agent mingru --recurrence.layers 2 --ppo.advantage-normalisation batch",
        "--agent none --recurrence.layers 2",
        ONE_STEP,
        f"{ONE_STEP} --ppo.advantage-normalisation batch",
    ],
)
def test_one_update_equals_that_of_the_python_agents(
    flags: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, flags = (flags, "") if flags.startswith("popgym") else (GRID, flags)
    run = new_run(tmp_path / "run", f"{flags} --ppo.updates 1 --threads 2", env)
    before, after = numbered(run, 0), numbered(run, 1)
    settings, agent = before.settings, before.agent
    monkeypatch.setattr(Agent, "noise", lambda self, shape, generator: noise_of(1, 0, shape, agent.branches))
    with Environments(settings) as environments:
        collector = RolloutCollector(agent, environments, settings.ppo.steps, torch.Generator())
        segment, ended = collector.collect(Clock())
        optimizer = ppo.make_optimizer(agent, settings.ppo.learning_rate)
        states = [memory.state for memory in collector.memories]
        # The only minibatch has all sequences, so their order does not matter.
        metrics = ppo.learn(agent, optimizer, segment, states, 0, settings.ppo, torch.Generator())
    (row,) = read_progress(run)
    if ended:
        assert row["episode/length"] == pytest.approx(np.mean([episode["length"] for episode in ended]))
    assert {name for name in row if "/" not in name} == {*metrics, "update", "steps", "steps_per_second"}
    for name, number in metrics.items():
        given = float("nan") if row[name] is None else row[name]
        assert given == pytest.approx(number, rel=1e-4, abs=1e-4, nan_ok=name == "explained_variance"), name
    for name, weights in agent.state_dict().items():
        assert torch.allclose(after.agent.state_dict()[name], weights, rtol=0, atol=1e-4), name
        assert bool(weights.isfinite().all()), name


@pytest.mark.parametrize("env", ["MultiarmedBanditEasy", "AutoencodeEasy", "BattleshipEasy", "MineSweeperEasy"])
def test_both_trainers_observe_the_same_vectors(env: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Values, entropies and the actions that are chosen depend on all entries. Weights stay; the run is resumed in an episode."""
    flags = "--ppo.steps 128 --ppo.learning-rate 0 --ppo.final-learning-rate 0 --ppo.epochs 1 --ppo.updates"
    run = new_run(tmp_path / "run", f"{flags} 1", f"popgym-{env}-v0")
    learn(f"--resume {run} --ppo.updates 3")
    settings, agent, update, ends = numbered(run, 0).settings, numbered(run, 0).agent, 0, 0
    assert settings.environment.wrapper == Settings(env=settings.env).validated().environment.wrapper == (VECTORS,)
    monkeypatch.setattr(Agent, "noise", lambda self, shape, generator: noise_of(1, update, shape, agent.branches))
    with Environments(settings) as environments:
        collector, optimizer = (
            RolloutCollector(agent, environments, 128, torch.Generator()),
            ppo.make_optimizer(agent, 0.0),
        )
        for update, row in enumerate(read_progress(run)):
            segment, ended = collector.collect(Clock())
            ends += len(ended)
            states = [memory.state for memory in collector.memories]
            metrics = ppo.learn(agent, optimizer, segment, states, update, settings.ppo, torch.Generator())
            for name in ("value", "entropy", "value_loss", "advantage", "gradient_norm"):
                assert row[name] == pytest.approx(metrics[name], rel=1e-4, abs=1e-6), (update, name)
    assert update == 2 and ends >= 8


def test_a_run_without_the_previous_action_stays_so(tmp_path: Path) -> None:
    run = new_run(tmp_path / "run", f"--environment.wrapper {ONE_HOT} --ppo.updates 1", "popgym-AutoencodeEasy-v0")
    through = new_run(
        tmp_path / "through", f"--environment.wrapper {ONE_HOT} --ppo.updates 2", "popgym-AutoencodeEasy-v0"
    )
    learn(f"--resume {run} --ppo.updates 2")
    one, two = (checkpoint.load(each).agent for each in (run, through))
    assert one.observation_shapes == {"features": (6,)}
    assert all(torch.equal(weights, two.state_dict()[name]) for name, weights in one.state_dict().items())
    assert "--environment.wrapper must be" in learn(
        f"MortarMayhemB-Grid-v0 --environment.wrapper {VECTORS} --run {tmp_path / 'other'}", fails=True
    )


def test_the_python_tools_read_a_run(tmp_path: Path, call: Callable[..., int]) -> None:
    run = new_run(tmp_path / "run", "--ppo.updates 3 --checkpoint-interval 1")
    ((found, files),) = protocol.find((tmp_path,), False)
    assert found == run and [file.stem for file in files] == [f"update-{update:06d}" for update in range(4)]
    loaded = checkpoint.load(run)
    assert (loaded.update, loaded.steps, loaded.settings.env) == (3, 3 * 8 * 16, "MortarMayhem-Grid-v0")
    assert len(evaluate(loaded.agent, range(200_000, 200_003), 1, num_threads=1)) == 3
    assert call(plot.main, run, "--out", tmp_path / "plots") == 0 and any((tmp_path / "plots").glob("*.png"))
    with pytest.raises(ValueError, match=rf"continue it with: endless learn --resume {run}, or .*--init-from"):
        train(parse(["--resume", str(run)]))
    (run / "checkpoints/last.safetensors").rename(run / "checkpoints/last.pt")
    assert f"continue it with: endless-train --resume {run}; " in learn(f"--resume {run}", fails=True)
    (run / "checkpoints/last.pt").rename(run / "checkpoints/last.safetensors")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run)).Reload()
    row = read_progress(run)[-1]
    assert [event.step for event in events.Scalars("learning/loss")] == [128, 256, 384]
    assert events.Scalars("episode/reward")[-1].value == pytest.approx(row["episode/reward"])


@pytest.mark.parametrize("id", ["popgym-AutoencodeEasy-v0", "endless_gym:popgym-RepeatPreviousEasy-v0"])
def test_a_run_in_an_environment_of_integers_is_recorded_and_exported(
    id: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    call: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Python imports the module before the `:`, which the program has.
    run, out = new_run(tmp_path / "run", "--ppo.updates 1", id), tmp_path / "agent.safetensors"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert call(record.main, run, "--episodes", 3) == 0
    assert call(export.main, run, "--out", out, "--vectors", tmp_path / "vectors") == 0
    printed = capsys.readouterr().out
    assert "\n3 episodes, " in f"\n{printed}" and "the page does not" in printed
    exported, trained = checkpoint.load(out), checkpoint.load(run)
    assert exported.settings.environment.wrapper == trained.settings.environment.wrapper == (VECTORS,)
    results = [evaluate(each.agent, range(200_000, 200_003), 1, greedy=True) for each in (exported, trained)]
    assert [result["length"] for result in results[0]] == [result["length"] for result in results[1]]


def test_weights_of_either_program_start_a_run_of_the_other(tmp_path: Path, call: Callable[..., int]) -> None:
    run = new_run(tmp_path / "rust", "--ppo.updates 1")
    given = parse(f"--env {GRID} --preset quick {FLAGS} --threads 1 --ppo.updates 1".split())
    ours = train(replace(given, run=str(tmp_path / "python"), init_from=str(run)))
    started = checkpoint.load(ours / "checkpoints" / "update-000000.pt").agent.state_dict()
    assert all(torch.equal(weights, started[name]) for name, weights in checkpoint.load(run).agent.state_dict().items())
    file = tmp_path / "exported.safetensors"
    assert call(export.main, ours, "--weights", file) == 0
    started = numbered(new_run(tmp_path / "next", f"--init-from {file} --ppo.updates 1"), 0).agent.state_dict()
    trained = checkpoint.load(ours).agent.state_dict()
    assert all(torch.equal(weights, started[name]) for name, weights in trained.items())
    assert set(load_file(file)) == set(trained)


def test_a_damaged_or_forged_checkpoint_is_refused(tmp_path: Path) -> None:
    run = new_run(tmp_path / "run", "--ppo.updates 1")
    file = run / "checkpoints" / "last.safetensors"
    content = np.fromfile(file, np.uint8)
    for length in (*range(0, len(content), 997), len(content) - 1):
        content[:length].tofile(file)
        with pytest.raises(ValueError, match="safetensors"):
            checkpoint.load(file)
    content.tofile(file)
    weights, whole = load_file(file), checkpoint.load(file).state
    header = {name: whole[name] for name in ("version", "settings", "update", "steps")}
    for text in ("[" * 100_000, '{"a":' * 100_000, "[]", "3", "{}", json.dumps(header | {"settings": 3})):
        save_file(weights, file, {"endless": text, "crc32": checkpoint._checksum(text, weights)})
        with pytest.raises(ValueError, match=r"is damaged|are invalid"):
            checkpoint.load(file)
    # A header of the format that claims more than the file has.
    for entry in ({"shape": [10**9], "data_offsets": [0, 4 * 10**9]}, {"shape": [10**10] * 3, "data_offsets": [0, 4]}):
        head = json.dumps({"a": {"dtype": "F32", **entry}}).encode()
        for length in (len(head), 10**9, 2**63):
            file.write_bytes(struct.pack("<Q", length) + head + bytes(4))
            with pytest.raises(ValueError, match="is not a file of safetensors"):
                checkpoint.load(file)


@contextmanager
def training(run: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that trains in `run`, after its first update, until it is killed."""
    arguments = f"--resume {run}" if run.exists() else f"{GRID} {FLAGS} --run {run}"
    flags = "--ppo.updates 1000000 --checkpoint-interval 1 --no-keep-checkpoints"
    command = [*PROGRAM, *arguments.split(), *flags.split()]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert "Ctrl-C stops the run" in process.stdout.readline()
            assert " steps " in process.stdout.readline()
            yield process
        finally:
            process.kill()


def test_signals_end_a_run_with_a_checkpoint_and_a_killed_one_resumes(tmp_path: Path) -> None:
    run, updates = tmp_path / "run", 0
    for number in (*STOP_SIGNALS, signal.SIGKILL):
        with training(run) as process:
            with pytest.raises(RunInUse, match=f"in use by process {process.pid} on "), locked(run):
                pass
            process.send_signal(number)
            process.communicate(timeout=60)
        saved, rows = checkpoint.load(run).update, len(read_progress(run))
        if number == signal.SIGKILL:
            assert process.returncode == -number and rows - 1 <= saved <= rows
        else:
            assert process.returncode == 0 and saved == rows > updates and not (run / "lock").exists()
        updates = saved
    with locked(run):
        assert "in use by process" in learn(f"--resume {run} --ppo.updates 1", fails=True)
    assert f"{updates} of 1 updates done" in learn(f"--resume {run} --ppo.updates 1")


@contextmanager
def serving(name: str, *flags: str) -> Iterator[subprocess.Popen[str]]:
    """A process that serves the environments of `FLAGS` in two groups, with the training seeds of the first seed."""
    flags += ("--num-envs", "4", "--groups", "2", "--option", "command_count=[1]", "--seed-range", "0..100000")
    command = [*ENDLESS, "serve", "--env", "MortarMayhem-Grid-v0", "--service", name, "--seed", "1", *flags]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.terminate()


def test_a_run_in_a_served_engine_outlives_the_engine(tmp_path: Path) -> None:
    name, run = f"learn-{tmp_path.name}", tmp_path / "run"
    flags = ["--features", "--no-frames", "--autoreset", "same-step"]
    given = f"MortarMayhem-Grid-v0 --connect {name} {FLAGS} --ppo.updates 1000000 --run {run}"
    command = [*PROGRAM, *given.replace("--environment.num-envs 8 ", "").split()]
    with serving(name, *flags) as engine:
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            while " steps " not in process.stdout.readline():
                assert process.poll() is None, process.stderr and process.stderr.read()
            engine.kill()
            errors = process.communicate(timeout=60)[1]
        saved = checkpoint.load(run).update
        assert process.returncode == 1 and saved > 0 and len(read_progress(run)) == saved
        assert re.fullmatch(
            rf"endless: engine `{name}` .* has ended; .*after update {saved}; continue with: .*\n", errors
        )
    learn(f"--resume {run} --ppo.updates {saved + 2}")
    expected = new_run(tmp_path / "expected", f"--ppo.updates {saved + 2} --environment.groups 2")
    resumed, undisturbed = (checkpoint.load(each).agent.state_dict() for each in (run, expected))
    assert all(torch.equal(weights, resumed[name]) for name, weights in undisturbed.items())
    with serving(name):
        error = learn(f"MortarMayhem-Grid-v0 --connect {name} --run {tmp_path / 'other'}", fails=True)
    assert "must serve 2 groups of 4 environments MortarMayhem-Grid-v0 with autoreset same_step" in error


def learn_each(commands: list[list[str]]) -> list[str]:
    """What `endless learn` prints for each of several lists of arguments."""
    code = "import json, sys; from endless_gym import _native\n"
    code += "for given in json.load(sys.stdin): print('=====', flush=True); _native.endless(['learn', *given], [])"
    process = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps(commands),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=120,
    )
    return process.stdout.split("=====\n")[1:]


def described(*arguments: str) -> dict[str, str]:
    """The options of `endless learn` that `endless-train` has, too: what `--help` says of each, by its name in `Settings`."""
    (text,) = learn_each([[*arguments, "--help"]])
    options = re.findall(r"^ +(?:-\w, )?--([\w.-]+)(.*?)(?=^ +(?:-\w, )?--|\Z)", text, re.DOTALL | re.MULTILINE)
    found = {name.replace("-", "_"): text for name, text in options}
    for name in ("connect", "log", "help"):
        del found[name]
    assert len(found) > 35
    return found


@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_defaults_and_presets_are_those_of_the_python_agents(preset: str) -> None:
    # The trainer in Rust always takes features, and steps on the thread that acts.
    others = ("preset", "environment.observation", "environment.num_threads")
    for name, text in described("--preset", preset).items():
        expected, found = value(PRESETS[preset], name), re.search(r"\[default: (.*?)\]", text, re.DOTALL)
        if name not in others and expected not in ("", (), None):
            assert found is not None, name
            given = found[1] if isinstance(expected, str) else json.loads(found[1])
            assert given == expected, name


def test_help_texts_are_those_of_the_python_agents() -> None:
    # Another meaning, or other choices.
    others = ("agent", "threads", "init_from", "environment.option", "environment.observation", "environment.wrapper")
    expected = documented_settings()
    for name, text in described().items():
        if name not in others:
            # After the name of the value, and before the default or the possible values.
            text = re.sub(r"^ *(<[^>]*>|\[=<[^>]*>\])?", "", text)
            said = " ".join(re.split(r"\[default|\[possible|Possible", text)[0].split())
            assert expected[name].startswith(said[0].lower() + said[1:].rstrip(".")), name


def test_ranges_are_those_of_the_python_agents() -> None:
    commands, expected = [], []
    for name in described():
        group, _, field = name.rpartition(".")
        owner = type(value(Settings(), group)) if group else Settings
        hint = get_type_hints(owner, include_extras=True)[field]
        for allowed in getattr(hint, "__metadata__", ()):
            step = 1 if isinstance(value(Settings(), name), int) else 1e-6
            numbers = {end + way * step for end in (allowed.low, allowed.high) for way in (-1, 0, 1)} | {float("nan")}
            for number in numbers:
                commands.append([f"--{name.replace('_', '-')}={number}", "--preset=unknown"])
                expected.append(number in allowed)
    assert len(commands) > 100
    for command, output, is_allowed in zip(commands, learn_each(commands), expected, strict=True):
        assert ("'unknown' for '--preset" in output) is is_allowed, (command, output)


def test_runs_are_as_long_as_those_of_the_python_agents(tmp_path: Path) -> None:
    small = f"{ONE_STEP} --ppo.updates 0 --ppo.minibatches 1 --recurrence.hidden-size 1 --time-limit 1e-9".split()
    cases = [(id, agent) for id in all_specs() if "popgym" not in id for agent in ("gru", "mingru", "none")]
    commands = [[id, "--agent", agent, "--run", str(tmp_path / f"{id}-{agent}"), *small] for id, agent in cases]
    for case, output in zip(cases, learn_each(commands), strict=True):
        assert f"1 of {paper_run_length(*case) * PAPER_STEPS_PER_UPDATE} updates done" in output, output
