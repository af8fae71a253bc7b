"""Experiments as data: the JSON files of this folder, read into checked values.

An experiment has a title, the section of the paper, a kind and runs. Each run is an environment and flags of `endless-train`
without dashes, such as `{"agent": "trxl", "transformer.layers": 4}`; it is repeated with the seeds 1 to `seeds`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_args

from endless_gym.specs import spec
from endless_gym_agents.common import regular
from endless_gym_agents.paper.search_space import with_choices
from endless_gym_agents.settings import PRESETS, Settings

#: Value of a flag.
Value = str | int | float | bool | list[str]
Kind = Literal["curves", "ablation", "wall-time", "simulation-speed", "search"]
Aggregate = Literal["", "finite", "endless"]

#: Flags that the program sets itself.
_RESERVED = ("env", "seed", "run", "resume", "device", "threads", "checkpoint-interval", "keep-checkpoints")


@dataclass(frozen=True)
class Run:
    """One row of an experiment.

    Attributes:
        name: Name of the run; runs with the same name and environment are the same run, even in different experiments.
        env: Environment id.
        flags: Flags of `endless-train` without dashes, and their values.
        published: Name of the published curve in `endless-plot`; empty if there is none.
        values: Published numbers, by column of the experiment's table.
    """

    name: str
    env: str
    flags: Mapping[str, Value] = field(default_factory=dict)
    published: str = ""
    values: Mapping[str, float] = field(default_factory=dict)

    def settings(self) -> Settings:
        """The settings of the training run, validated."""
        return settings_of(self.env, self.flags).validated()


@dataclass(frozen=True)
class Evaluation:
    """How runs of the kind `curves` are evaluated; the defaults are the paper's protocol.

    Attributes:
        interval: Updates between two evaluated checkpoints.
        seeds: Number of evaluation seeds, from 200,000 on.
        repetitions: Episodes per seed.
    """

    interval: int = 500
    seeds: int = 50
    repetitions: int = 3


@dataclass(frozen=True)
class Search:
    """Flags of `endless-search` for the kind `search`.

    Attributes:
        trials: Number of combinations.
        warm_up: Updates before a trial can be pruned.
        parameters: Parameters to search; empty for the paper's table.
    """

    trials: int = 50
    warm_up: int = 2000
    parameters: tuple[str, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """An experiment of the paper.

    Attributes:
        name: Name, as `endless-reproduce` takes it.
        title: Title.
        section: Section or appendix of the paper.
        about: What is compared, and what the paper reports.
        kind: What is run and reported.
        seeds: Number of repetitions of each run.
        runs: The runs.
        aggregate: `finite` or `endless` for a plot over these environments; empty for none.
        evaluation: The evaluation of the kind `curves`.
        search: The search of the kind `search`.
        episodes: Episodes of each environment of the kind `simulation-speed`.
    """

    name: str
    title: str
    section: str
    about: str
    kind: Kind
    seeds: int
    runs: tuple[Run, ...]
    aggregate: Aggregate = ""
    evaluation: Evaluation = Evaluation()
    search: Search = Search()
    episodes: int = 1000


def settings_of(env: str, flags: Mapping[str, Value]) -> Settings:
    """The settings that flags of `endless-train` describe.

    Raises:
        ValueError: An unknown flag, or a value of another type.
    """
    preset = flags.get("preset", "paper")
    if preset not in PRESETS:
        raise ValueError(f"`preset` must be one of {', '.join(PRESETS)}, got `{preset}`")
    base = PRESETS[str(preset)]
    known = known_flags()
    changes: dict[str, Any] = {"env": env}
    for name, value in flags.items():
        if name not in known:
            raise ValueError(f"unknown flag `{name}`; allowed: {', '.join(known)}")
        kind = known[name]
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not (list if kind is tuple else kind):
            raise ValueError(f"flag `{name}` must be {'list' if kind is tuple else kind.__name__}, got {value!r}")
        changes[name.replace("-", "_")] = tuple(value) if isinstance(value, list) else value
    return with_choices(base, changes)


def known_flags() -> dict[str, type]:
    """The flags that a run may set, with the types of their values."""
    known: dict[str, type] = {}
    for part in dataclasses.fields(Settings):
        value = getattr(PRESETS["paper"], part.name)
        if dataclasses.is_dataclass(value):
            known |= {
                f"{part.name}.{entry.name}".replace("_", "-"): type(getattr(value, entry.name))
                for entry in dataclasses.fields(value)
            }
        elif part.name.replace("_", "-") not in _RESERVED and value is not None:
            known[part.name.replace("_", "-")] = type(value)
    return known


def names() -> list[str]:
    """Names of the paper's experiments, in the order of its sections."""
    files = [Path(str(file)) for file in resources.files(__package__).iterdir() if str(file).endswith(".json")]
    return [file.stem for file in sorted(files, key=lambda file: (json.loads(file.read_text())["section"], file.stem))]


def load(name: str) -> Experiment:
    """Read an experiment of the paper by name, or one of your own from a JSON file.

    Raises:
        ValueError: There is no such experiment, or the file is invalid.
        FileNotFoundError: There is no such file.
    """
    if name.endswith(".json"):
        file = Path(name)
        if not file.exists():
            raise FileNotFoundError(f"no such file: {file}; expected an experiment as JSON")
        return parse(file.stem, regular.text(file))
    if name not in names():
        raise ValueError(f"experiment must be one of {', '.join(names())}, or a JSON file; got `{name}`")
    return parse(name, (resources.files(__package__) / f"{name}.json").read_text())


def parse(name: str, text: str) -> Experiment:
    """Read an experiment from JSON.

    Raises:
        ValueError: The text is not JSON, a key is unknown or missing, or a value is invalid; the message says what is allowed.
    """
    try:
        given = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"experiment {name}: not JSON: {error}") from None
    where = f"experiment {name}"
    fields = _checked(Experiment, given, where, without=("name",))
    if fields["kind"] not in get_args(Kind):
        raise ValueError(f"{where}: `kind` must be one of {', '.join(get_args(Kind))}, got {fields['kind']!r}")
    if fields.get("aggregate", "") not in ("", "finite", "endless"):
        raise ValueError(f"{where}: `aggregate` must be finite or endless, got {fields['aggregate']!r}")
    for key, kind in (("evaluation", Evaluation), ("search", Search)):
        if key in fields:
            fields[key] = kind(**_checked(kind, fields[key], f"{where}, `{key}`"))
    for key in ("seeds", "episodes"):
        if fields.get(key, 1) < 1:
            raise ValueError(f"{where}: `{key}` must be 1 or more, got {fields[key]}")
    runs = []
    for number, one in enumerate(fields["runs"]):
        row = f"{where}, run {number + 1}"
        run = Run(**_checked(Run, one, row))
        try:
            run = dataclasses.replace(run, env=spec(run.env).full_id)
            run.settings()
        except ValueError as error:
            raise ValueError(f"{row}: {error}") from None
        runs.append(run)
    if not runs:
        raise ValueError(f"{where}: `runs` must contain at least one run")
    fields["runs"] = tuple(runs)
    made = Experiment(name=name, **fields)
    keys = [(run.env, run.name) for run in runs]
    twice = {key for key in keys if keys.count(key) > 1}
    if twice:
        raise ValueError(f"{where}: the names of runs in an environment must differ, got twice: {sorted(twice)}")
    return made


#: JSON type for each annotation in the classes above, by the annotation's name without type arguments.
_TYPES: dict[str, type] = {"str": str, "Kind": str, "Aggregate": str, "int": int, "tuple": list}
_TYPES |= dict.fromkeys(("Evaluation", "Search", "Mapping"), dict)


def _checked(kind: Any, given: object, where: str, without: tuple[str, ...] = ()) -> dict[str, Any]:
    """The values of the fields of a class, by name, after a check of keys and types."""
    if not isinstance(given, dict):
        raise ValueError(f"{where}: must be an object, got {given!r}")
    fields = {one.name.replace("_", "-"): one for one in dataclasses.fields(kind) if one.name not in without}
    allowed = ", ".join(fields)
    for key in given:
        if key not in fields:
            raise ValueError(f"{where}: unknown key `{key}`; allowed: {allowed}")
    for key, one in fields.items():
        optional = one.default is not dataclasses.MISSING or one.default_factory is not dataclasses.MISSING
        if key not in given and not optional:
            raise ValueError(f"{where}: `{key}` is missing; allowed: {allowed}")
        expected = _TYPES[str(one.type).partition("[")[0]]
        if key in given and type(given[key]) is not expected:
            raise ValueError(f"{where}: `{key}` must be {expected.__name__}, got {given[key]!r}")
    return {
        fields[key].name: tuple(value) if str(fields[key].type) == "tuple[str, ...]" else value
        for key, value in given.items()
    }
