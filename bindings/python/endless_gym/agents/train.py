"""`endless-train`: train an agent.

```console
endless-train --env Endless-MortarMayhem-v0 --agent gru
endless-train --env MortarMayhem-Grid-v0 --environment.option command_count=[1] --agent trxl --preset quick
```
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import torch

from endless_gym.agents import checkpoint, command
from endless_gym.agents.agent import make_agent
from endless_gym.agents.clock import Clock
from endless_gym.agents.environments import Environments
from endless_gym.agents.logs import Episodes, Logger
from endless_gym.agents.ppo import learn
from endless_gym.agents.rollout import Player
from endless_gym.agents.settings import PRESETS, Settings, to_dict


def train(settings: Settings, watch: Callable[[int, dict[str, float]], bool] | None = None) -> Path:
    """Train, from the start or from a run's last checkpoint.

    Args:
        settings: Of the run.
        watch: Is told, after each update, its number and the means of the last episodes, and may stop the run.

    Returns:
        The run's folder, with `settings.json`, `progress.jsonl`, TensorBoard's files and `checkpoints`.
    """
    settings, resumed = settings.checked(), None
    if settings.resume:
        run = Path(settings.resume)
        resumed = command.load_checkpoint(run, "cpu").state
        same_network(settings, checkpoint.read_settings(run))
        settings = dataclasses.replace(settings, resume="", run=str(run))
    else:
        run = Path(
            settings.run or f"runs/{settings.env}/{settings.agent}-{settings.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
        )
        if (run / checkpoint.SETTINGS).exists():
            raise FileExistsError(f"{run} has a run already; go on with --resume {run}, or name another folder")
        run.mkdir(parents=True, exist_ok=True)

    # Everything random follows from the seed.
    device = choose_device(settings.device)
    if settings.threads:
        torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    generators = {
        "actions": torch.Generator(device).manual_seed(settings.seed),
        "minibatches": torch.Generator().manual_seed(settings.seed),
    }

    ppo, started, stop = settings.ppo, time.monotonic(), Interrupt()
    with Environments(settings) as environments, stop:
        agent = make_agent(settings, environments.spec, device)
        if settings.compile:
            agent.compile_parts()
        optimizer = torch.optim.AdamW(agent.parameters(), lr=ppo.learning_rate)
        player = Player(agent, environments, ppo.steps, generators["actions"])
        episodes, update, steps = Episodes(), 0, 0
        if resumed is not None:
            update, steps = resumed["update"], resumed["steps"]
            agent.load_state_dict(resumed["model"])
            optimizer.load_state_dict(resumed["optimizer"])
            for name, generator in generators.items():
                go_on_drawing(generator, resumed["generators"][name], settings.seed + update)
            episodes.add(resumed["episodes"])
            player.load(resumed["player"])

        def save() -> None:
            state: dict[str, Any] = {
                "settings": to_dict(settings),
                "update": update,
                "steps": steps,
                "model": agent.state_dict(),
                "optimizer": optimizer.state_dict(),
                "generators": {name: generator.get_state() for name, generator in generators.items()},
                "player": player.state(),
                "episodes": list(episodes.recent),
            }
            checkpoint.save(run, state, settings.keep_checkpoints)

        logger = Logger(run, settings, update)
        # Now that nothing has failed: what was changed to go on holds from here on.
        (run / checkpoint.SETTINGS).write_text(json.dumps(to_dict(settings), indent=1) + "\n")
        if resumed is None:
            save()
        logger.say(
            f"{settings.env}: {settings.agent} with {agent.num_parameters:,} parameters on {device}, in {run}; Ctrl-C stops it"
        )

        clock = Clock((lambda: torch.cuda.synchronize(device)) if device.type == "cuda" else None)
        while update < ppo.updates and not stop.requested:
            start = time.perf_counter()
            segment, ended = player.play(clock)
            with clock.measure("learning"):
                states = [memory.state for memory in player.memories]
                measures = learn(agent, optimizer, segment, states, update, ppo, generators["minibatches"])
            new_steps = environments.groups * environments.per_group * ppo.steps
            update, steps = update + 1, steps + new_steps
            episodes.add(ended)
            means = episodes.means()
            rate = new_steps / (time.perf_counter() - start)
            logger.update({"update": update, "steps": steps, "steps_per_second": rate} | means | measures, clock.take())

            minutes = (time.monotonic() - started) / 60
            if settings.time_limit and minutes >= settings.time_limit:
                stop.requested = True
            reward, target = means.get("episode/reward"), settings.target_reward
            if reward is not None and target is not None and episodes.is_full() and reward >= target:
                stop.requested = True
            if watch is not None and watch(update, means):
                stop.requested = True
            if update % settings.checkpoint_interval == 0 or update >= ppo.updates or stop.requested:
                save()
        logger.say(f"{update} of {ppo.updates} updates are done; go on with: endless-train --resume {run}")
        logger.close()
    return run


class Interrupt:
    """Lets an update finish when Ctrl-C is pressed; pressed again, it interrupts at once."""

    def __init__(self) -> None:
        self.requested = False
        self._before: Any = None

    def __enter__(self) -> Interrupt:
        try:
            self._before = signal.signal(signal.SIGINT, self._on_signal)
        except ValueError:  # Only the main thread may; others are not interrupted.
            self._before = None
        return self

    def __exit__(self, *exception: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        print("\nstopping after this update, with a checkpoint; press Ctrl-C again to stop at once", file=sys.stderr)


def same_network(settings: Settings, before: Settings) -> None:
    """Refuses to go on with another network, other environments or another seed than a run began with.

    Raises:
        ValueError: Something differs.
    """
    # Where environments are stepped may change, and all of PPO but the losses that have a head of their own.
    had = before.environment
    place = dataclasses.replace(settings.environment, engine=had.engine, num_threads=had.num_threads)
    settings = dataclasses.replace(settings, environment=place)
    for name in ("env", "agent", "preset", "seed", "environment", "model", "recurrence", "transformer"):
        given, had = getattr(settings, name), getattr(before, name)
        if given != had:
            raise ValueError(
                f"the run to resume began with {name} {had}, not {given}; leave it as it was, or start a run"
            )
    for name in ("reconstruction", "ground_truth"):
        wants, has = (getattr(each.ppo, f"{name}_coefficient") for each in (settings, before))
        if bool(wants) != bool(has):
            raise ValueError(
                f"--ppo.{name.replace('_', '-')}-coefficient {wants:g} adds or takes away a head, and the run to resume began "
                f"with {has:g}; leave it as it was, or start a run"
            )


def go_on_drawing(generator: torch.Generator, state: torch.Tensor, seed: int) -> None:
    """Puts a generator into a checkpoint's state; one of another kind of device starts anew with `seed`."""
    if state.shape == generator.get_state().shape:
        generator.set_state(state)
    else:
        generator.manual_seed(seed)


def choose_device(name: str) -> torch.device:
    """The device of that name; `auto` is CUDA where there is one.

    Raises:
        ValueError: There is no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(f"no device `{name}`; give auto, cpu, cuda or cuda:NUMBER") from None
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise ValueError(f"device `{name}`: PyTorch finds no CUDA device; give cpu or auto")
        if (device.index or 0) >= torch.cuda.device_count():
            raise ValueError(f"device `{name}`: there are cuda:0 to cuda:{torch.cuda.device_count() - 1}")
    return device


def parse(arguments: list[str]) -> Settings:
    """Settings from the command line: the preset's, or the resumed run's, changed by the other flags."""
    import tyro

    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="paper")
    first.add_argument("--resume", default="")
    chosen = first.parse_known_args(arguments)[0]
    if chosen.resume:
        defaults = dataclasses.replace(checkpoint.read_settings(chosen.resume), time_limit=0.0)
    else:
        # tyro tells what presets there are if there is none of that name.
        defaults = PRESETS.get(chosen.preset, PRESETS["paper"])
    description = "Train one of the paper's agents with PPO: endless-train --env Endless-MortarMayhem-v0 --agent gru"
    return tyro.cli(Settings, prog="endless-train", description=description, args=arguments, default=defaults)


def main() -> int:
    """The command `endless-train`."""
    return command.run("endless-train", lambda: train(parse(sys.argv[1:])))


if __name__ == "__main__":
    sys.exit(main())
