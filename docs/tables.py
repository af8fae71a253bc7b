"""Tables of an environment, from the output of `endless list --json`."""

import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

Spec = dict[str, Any]

#: The limits of a parameter that has none.
UNLIMITED = (-(2**63), 2**63 - 1)

#: Infos of all environments, which are not in their tables.
COMMON_INFOS = [
    {"name": "reward", "description": "sum of the rewards of the episode"},
    {"name": "length", "description": "steps of the episode"},
]


def read(file: Path) -> dict[str, Spec]:
    """The environments by their ids."""
    return {spec["id"]: spec for spec in json.loads(file.read_text())}


def table(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join(f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def overview(specs: Iterable[Spec]) -> str:
    """Environments with links to their pages."""
    rows = [[f"[{spec['id']}]({spec['id']}.md)", f"`{actions(spec)}`", spec["summary"]] for spec in specs]
    return table(["id", "actions", "task"], rows)


def actions(spec: Spec) -> str:
    """The action space as Gymnasium writes it."""
    ((kind, choices),) = spec["action_space"].items()
    # A line does not break in it.
    return f"{kind}({choices})".replace(" ", "\N{NO-BREAK SPACE}")


def spaces(spec: Spec) -> str:
    """Actions, observation, ground truth and frame rate."""
    shape = tuple(spec["observation_shape"])
    observation = f"uint8 {shape}, indexed `[x][y][channel]`"
    if length := spec["vector_observation"]:
        observation = f"a dict: `visual_observation`, {observation}; `vector_observation`, float32 ({length},)"
    truth = f'float64 ({len(spec["ground_truth"])},), `info["ground_truth"]`' if spec["ground_truth"] else "none"
    rows = [
        ["action space", f"`{actions(spec)}`"],
        ["observation", observation],
        ["ground truth", truth],
        ["frames per second, when shown to people", spec["render_fps"]],
    ]
    return table(["", ""], rows)


def meanings(spec: Spec) -> str:
    """What the numbers of an action mean, by branch."""
    branches = spec["actions"]
    several = len(branches) > 1
    rows = [
        [*([f"`action[{number}]`, {branch['name']}"] if several else []), value, choice["name"], choice["description"]]
        for number, branch in enumerate(branches)
        for value, choice in enumerate(branch["choices"])
    ]
    return table([*(["branch"] if several else []), "number", "name", "meaning"], rows)


def ground_truth(spec: Spec) -> str:
    """The numbers of `info["ground_truth"]`."""
    rows = [[place, f"`{each['name']}`", each["description"]] for place, each in enumerate(spec["ground_truth"])]
    return table(["index", "name", "meaning"], rows)


def parameters(spec: Spec) -> str:
    """Reset parameters with defaults, limits and meaning."""
    rows = [
        [f"`{each['name']}`", f"`{json.dumps(each['default'])}`", allowed(each), each["description"]]
        for each in spec["parameters"]
    ]
    return table(["reset parameter", "default", "allowed", "meaning"], rows)


def allowed(parameter: dict[str, Any]) -> str:
    """The values of a reset parameter, in words."""
    kind, limits = parameter["type"], (parameter.get("min"), parameter.get("max"))
    if kind == "bool":
        return "true or false"
    noun = {"int": "integer", "float": "number", "int_list": "list of integers"}[kind]
    return noun if limits == UNLIMITED else f"{noun}, {number(limits[0])} to {number(limits[1])}"


def number(value: float) -> str:
    """A number with commas between its thousands."""
    return f"{int(value):,}" if value == int(value) else str(value)


def infos(spec: Spec) -> str:
    """Infos of an episode's last step."""
    return table(
        ["info", "meaning"], [[f"`{each['name']}`", each["description"]] for each in COMMON_INFOS + spec["info"]]
    )


def features(spec: Spec) -> str:
    """Columns of the feature observation; those that differ only in numbers, such as the places of a grid, share a row."""
    names: dict[tuple[str, str], list[str]] = {}
    for each in spec["features"]:
        names.setdefault((re.sub(r"\d+", "{}", each["name"]), each["description"]), []).append(each["name"])
    rows = [[f"`{ranges(template, same)}`", meaning] for (template, meaning), same in names.items()]
    return table(["feature", "meaning"], rows)


def ranges(template: str, names: Sequence[str]) -> str:
    """`coin_{0..7}_x` for `coin_0_x` to `coin_7_x`."""
    if len(names) == 1:
        return names[0]
    places = zip(*(map(int, re.findall(r"\d+", name)) for name in names), strict=True)
    return template.format(*(f"{{{min(place)}..{max(place)}}}" for place in places))


PARTS = {
    "spaces": spaces,
    "actions": meanings,
    "ground truth": ground_truth,
    "parameters": parameters,
    "infos": infos,
    "features": features,
}
