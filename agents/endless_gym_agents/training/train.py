"""`endless-train`: train an agent, in one process or, started by `torchrun`, in several.

```console
endless-train --env Endless-MortarMayhem-v0 --agent gru
endless-train --env MortarMayhem-Grid-v0 --environment.option 'command_count=[1]' --agent trxl --preset quick
torchrun --nproc-per-node=4 -m endless_gym_agents.train -- --env MortarMayhem-v0    # see `endless_gym_agents.environments.ranks`
```
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import signal
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import torch

from endless_gym import EngineLost
from endless_gym.episodes import EpisodeOptions
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.common import atomic, command
from endless_gym_agents.common.clock import Clock
from endless_gym_agents.environments.groups import Environments
from endless_gym_agents.environments.ranks import Ranks
from endless_gym_agents.settings import PRESETS, Settings, to_dict, value
from endless_gym_agents.training import checkpoint, run_folder
from endless_gym_agents.training.logs import RECENT, Logger, SilentLogger, learnt, means
from endless_gym_agents.training.ppo import Diverged, learn, make_optimizer
from endless_gym_agents.training.rollout import RolloutCollector


def train(
    settings: Settings,
    watch: Callable[[int, dict[str, float]], bool] | None = None,
    episode_options: EpisodeOptions | None = None,
) -> Path:
    """Train an agent in a new run, or resume a run from its last checkpoint. A run that ended before its first one starts again.

    Under `torchrun`, every process calls this function with the same settings. A run that `torchrun` restarts continues from its
    last checkpoint.

    Args:
        settings: Settings of the run.
        watch: Called after each update with its number and the means of the last 100 episodes; the run stops if it returns true.
        episode_options: Chooses the options of each episode, as for `make_vec`: a curriculum. Only with environments in this
            process. A checkpoint does not contain its state.

    Returns:
        The folder of the run, with `settings.json`, `progress.jsonl`, the TensorBoard files and `checkpoints`.

    Raises:
        ModuleNotFoundError: TensorBoard is not installed.
        RankLost: Another process of the run has ended.
        ValueError: The settings are invalid, or do not fit the run to resume.
        MissingRow: The log of the run to resume has no row of an update before its checkpoint.
        RunInUse: Another process trains in the folder.
        FileExistsError: The folder already contains a run.
        FileNotFoundError: There is no run to resume.
        EngineLost: The engine process failed, and was not replaced; see `Settings.on_engine_failure`.
        Diverged: A loss, a gradient or the weights are no longer finite. The last checkpoint is from before.
    """
    command.check_installed("training", "tensorboard")
    if settings.resume and checkpoint.last(settings.resume).suffix == checkpoint.RUST_SUFFIX:
        raise ValueError(
            f"{settings.resume} is a run of `endless learn`; continue it with: endless learn --resume {settings.resume}, or "
            "start a new run from its weights with --init-from"
        )
    settings, ranks = settings.validated(), Ranks()
    ranks.check(settings.environment.num_envs, settings.environment.groups)
    device = choose_device(settings.device, ranks)
    if settings.bind_cores:
        ranks.bind()
    if settings.threads:
        torch.set_num_threads(settings.threads)
    if device.type == "cuda":
        torch.cuda.set_device(device)
        torch.set_float32_matmul_precision("high")  # TF32
    with ranks.connected(), contextlib.ExitStack() as held:
        folder, has_begun = ranks.of_first(lambda: held.enter_context(run_folder.opened(settings, ranks.restarts)))
        return train_rank(settings, ranks, device, Path(folder), has_begun, watch, episode_options)


def train_rank(
    settings: Settings,
    ranks: Ranks,
    device: torch.device,
    run: Path,
    has_begun: bool,
    watch: Callable[[int, dict[str, float]], bool] | None,
    episode_options: EpisodeOptions | None,
) -> Path:
    """The part of `train` that runs while the ranks are connected and the folder `run` is locked."""
    resumed: dict[str, Any] | None = None
    if settings.resume or has_begun:
        check_resumable(settings, checkpoint.read_settings(run))
        settings = dataclasses.replace(settings, resume="", run=str(run))
    # Until a checkpoint was saved, it is taken to last as long as loading one.
    started = time.monotonic()
    if has_begun:
        resumed = checkpoint.load(run).resumable()
        if ranks.is_first:
            checkpoint.remove_unlisted(checkpoint.last(run))
    saving = time.monotonic() - started

    torch.manual_seed(settings.seed)
    generators = {
        "actions": torch.Generator(device).manual_seed(settings.seed),
        "minibatches": torch.Generator().manual_seed(settings.seed),
    }

    ppo, stop = settings.ppo, Interrupt(ranks)
    with stop, Environments(settings, episode_options, ranks, pin_memory=device.type != "cpu") as environments:
        agent = make_agent(settings, environments.spec, device)
        started_from = checkpoint.start_from(agent, settings.init_from) if settings.init_from and not resumed else ""
        optimizer = make_optimizer(agent, ppo.learning_rate)
        collector = RolloutCollector(agent, environments, ppo.steps, generators["actions"], ranks)
        update, steps, saved, saved_at = 0, 0, resumed["update"] if resumed else 0, started
        episodes: deque[dict[str, float]] = deque(maxlen=RECENT)
        if resumed is not None:
            update, steps = resumed["update"], resumed["steps"]
            agent.load_state_dict(resumed["model"])
            with checkpoint.checked(run):
                optimizer.load_state_dict(resumed["optimizer"])
                for name, generator in generators.items():
                    restore_generator(generator, resumed["generators"][name], settings.seed + update)
                episodes.extend(resumed["episodes"])
                players = resumed["player"].get("ranks", [resumed["player"]])
                if len(players) == ranks.size:
                    collector.load_state_dict(players[ranks.rank])
                else:
                    collector.start_episodes([player["environments"] for player in players])
        ranks.copy_from_first(agent.state_dict().values())

        def save(keep: bool) -> None:
            nonlocal saved, saved_at, saving
            saved, saved_at = update, time.monotonic()
            players = ranks.gathered(collector.state_dict())
            if players is None:
                return
            state: dict[str, Any] = {
                "settings": to_dict(settings),
                "update": update,
                "steps": steps,
                "model": agent.state_dict(),
                "optimizer": optimizer.state_dict(),
                "generators": {name: generator.get_state() for name, generator in generators.items()},
                "player": players[0] if ranks.size == 1 else {"ranks": players},
                "episodes": list(episodes),
            }
            logger.sync()
            checkpoint.save(run, state, keep, settings.checkpoint_megabytes)
            saving = time.monotonic() - saved_at

        logger = Logger(run, settings, update, steps) if ranks.is_first else SilentLogger()
        # Written only after everything above has succeeded. A resumed run keeps its changed settings.
        if ranks.is_first:
            atomic.write(run / checkpoint.SETTINGS, json.dumps(to_dict(settings), indent=1) + "\n")
        if resumed is None:
            save(settings.keep_checkpoints)
        where = f"{device}" if ranks.size == 1 else f"{ranks.size} ranks"
        network = f"{settings.agent_name}, {agent.num_parameters:,} parameters"
        logger.print(f"{settings.env}: {network}, on {where}, in {run}; Ctrl-C stops the run")

        if started_from:
            logger.print(started_from)

        success: str | None = None
        clock, stops, longest = Clock(), False, 0.0
        while update < ppo.updates and not stops:
            start = time.monotonic()
            environments.mark(logger.print)
            segment, ended = collector.collect(clock)
            with clock.measure("learning"):
                states = [memory.state for memory in collector.memories]
                try:
                    learning = learn(agent, optimizer, segment, states, update, ppo, generators["minibatches"], ranks)
                except Diverged as error:
                    raise Diverged(f"{error}; with --resume {run}, which has a checkpoint of update {saved}") from None
            new_steps = settings.environment.num_envs * ppo.steps
            update, steps = update + 1, steps + new_steps
            for infos in ranks.everywhere(ended):
                episodes.extend(infos)
            recent = means(episodes)
            rate = new_steps / (time.monotonic() - start)
            logger.update(
                {"update": update, "steps": steps, "steps_per_second": rate} | recent | learning, clock.take()
            )

            reward, target = recent.get("episode/reward"), settings.target_reward
            if reward is not None and target is not None and len(episodes) == RECENT and reward >= target:
                stop.requested = True
            if settings.stop_when_learnt and target is None and len(episodes) == RECENT:
                success = learnt(environments.spec, recent)
                stop.requested = stop.requested or success is not None
            if environments.failure is not None:
                stop.requested = True
            if watch is not None and watch(update, recent):
                stop.requested = True
            now = time.monotonic()
            longest = max(longest, now - start)
            # Time for a checkpoint now, another update, and the last checkpoint.
            if settings.time_limit and started + 60 * settings.time_limit < now + longest + 2 * saving:
                stop.requested = True
            is_late = (
                bool(settings.checkpoint_minutes) and time.monotonic() >= saved_at + 60 * settings.checkpoint_minutes
            )
            # All ranks stop, or write a checkpoint, after the same update.
            stops, is_late = map(any, zip(*ranks.everywhere((stop.requested, is_late)), strict=True))
            is_planned = update % settings.checkpoint_interval == 0 or update >= ppo.updates or stops
            if is_planned or is_late:
                save(settings.keep_checkpoints and is_planned)
        if success is not None:
            logger.print(f"the task is learnt: {success}; train longer with --no-stop-when-learnt")
        more = f" --ppo.updates {2 * update}" if update >= ppo.updates else ""
        verb = "train longer" if more else "continue"
        logger.print(f"{update} of {ppo.updates} updates done; {verb} with: endless-train --resume {run}{more}")
        logger.close()
        failures = [failure for failure in ranks.everywhere(environments.failure) if failure is not None]
        if failures:
            raise EngineLost(
                f"{failures[0]}; the checkpoint is of update {update}; continue with: endless-train --resume {run}"
            )
    return run


class Interrupt:
    """Context manager that turns `command.STOP_SIGNALS` into a request to stop; a second SIGINT raises `KeyboardInterrupt`.

    `torchrun` forwards signals that the terminal has already sent: with several ranks, signals within two seconds count as one.

    Attributes:
        requested: Whether the run should stop after the current update.
    """

    def __init__(self, ranks: Ranks) -> None:
        self.requested = False
        self._ranks = ranks
        self._handled = command.on_stop_signals(self._on_signal)
        self._first = 0.0

    def __enter__(self) -> Interrupt:
        self._handled.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        self._handled.__exit__(None, None, None)
        if self._ranks.size > 1:
            # When one rank has ended, `torchrun` sends SIGTERM to the others, which are ending too.
            signal.signal(signal.SIGTERM, signal.SIG_IGN)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            # A scheduler or a closing terminal may send several signals; only another Ctrl-C asks for more.
            if number == signal.SIGINT and (self._ranks.size == 1 or time.monotonic() >= self._first + 2.0):
                raise KeyboardInterrupt
            return
        self.requested, self._first = True, time.monotonic()
        command.drop_lost_outputs()
        if self._ranks.is_first:
            print(
                "\nstopping after this update, with a checkpoint; press Ctrl-C again to stop immediately",
                file=sys.stderr,
            )


def check_resumable(settings: Settings, before: Settings) -> None:
    """Check that a run can be resumed with other settings: network, environments and seed must not change.

    Args:
        settings: The new settings.
        before: The settings of the run.

    Raises:
        ValueError: A setting that must not change differs.
    """
    # The engine and its threads may change, and so may all of PPO except what decays and whether the auxiliary heads exist.
    had = before.environment
    environment = dataclasses.replace(settings.environment, engine=had.engine, num_threads=had.num_threads)
    settings = dataclasses.replace(settings, environment=environment).resolved()
    own = ("agent", "agent_option", "encoder", "encoder_option")
    groups = ("environment", "model", "recurrence", "transformer")
    for name in ("env", *own, "preset", "seed", *groups, "ppo.weight_decay"):
        for part, given, had in _parts(name, value(settings, name), value(before, name)):
            if given != had:
                raise ValueError(
                    f"a resumed run must keep its {part}: expected {had}, got {given}; omit the flag, or start a new run"
                )
    for name in ("reconstruction", "ground_truth"):
        given, had = (getattr(each.ppo, f"{name}_coefficient") for each in (settings, before))
        if bool(given) != bool(had):
            raise ValueError(
                f"a resumed run must keep its heads: --ppo.{name.replace('_', '-')}-coefficient must stay "
                f"{'positive' if had else '0'} (it was {had:g}), got {given:g}; omit the flag, or start a new run"
            )


def _parts(name: str, given: Any, had: Any) -> list[tuple[str, Any, Any]]:
    """A setting, or the settings of a group, each with its name as a flag and two values."""
    if not dataclasses.is_dataclass(given):
        return [(name.replace("_", "-"), given, had)]
    fields = (field.name for field in dataclasses.fields(given))
    return [(f"{name}.{field.replace('_', '-')}", getattr(given, field), getattr(had, field)) for field in fields]


def restore_generator(generator: torch.Generator, state: torch.Tensor, seed: int) -> None:
    """Restore the state of a generator; seed it instead if the state, uint8 (bytes,), is from another type of device.

    Args:
        generator: The generator.
        state: State from a checkpoint.
        seed: Seed for a state that does not fit.
    """
    if state.shape == generator.get_state().shape:
        generator.set_state(state)
    else:
        generator.manual_seed(seed)


def choose_device(name: str, ranks: Ranks | None = None) -> torch.device:
    """The device with the name `cpu`, `cuda` or `cuda:INDEX`, or for `auto` CUDA if available, else the CPU.

    A CUDA device always has an index, by default 0. Several ranks on a machine each get their own GPU.

    Raises:
        ValueError: The name is invalid, or the device is not available.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(f"--device must be auto, cpu, cuda or cuda:INDEX, got `{name}`") from None
    if device.type == "cuda":
        if ranks is not None and ranks.local_size > 1:
            if device.index is not None:
                raise ValueError(f"--device must be auto, cpu or cuda with several ranks on a machine, got `{name}`")
            device = torch.device("cuda", ranks.local_rank)
        # `torch.cuda.set_device` refuses a device without an index.
        device = torch.device("cuda", device.index or 0)
        if not torch.cuda.is_available():
            raise ValueError(f"device `{name}`: PyTorch finds no CUDA device; use cpu or auto")
        if device.index >= torch.cuda.device_count():
            raise ValueError(f"device `{name}`: the index must be 0 to {torch.cuda.device_count() - 1}")
    return device


def parse(arguments: list[str]) -> Settings:
    """Parse command-line arguments; the defaults are those of `--preset`, or the settings of the run to `--resume`."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="paper")
    first.add_argument("--resume", default="")
    chosen = first.parse_known_args(arguments)[0]
    if chosen.resume:
        defaults = dataclasses.replace(checkpoint.read_settings(chosen.resume), time_limit=0.0, view=False)
    else:
        # tyro reports an unknown preset.
        defaults = PRESETS.get(chosen.preset, PRESETS["paper"])
    description = "Train one of the paper's agents with PPO: endless-train --env Endless-MortarMayhem-v0 --agent gru"
    return command.parse(Settings, "endless-train", description, arguments, default=defaults)


def main() -> int:
    """Entry point of the command `endless-train`; returns the exit status."""
    return command.run("endless-train", lambda: train(parse(sys.argv[1:])))


if __name__ == "__main__":
    sys.exit(main())
