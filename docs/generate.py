"""Write the generated parts of the pages: the tables of the environments. `hooks.py` adds the messages of errors to the site.

    endless list --json | python docs/generate.py            # writes into the pages
    endless list --json | python docs/generate.py --check    # fails if a page is stale

A comment in a page, `<!-- generated: PART ARGUMENT -->`, names a part; the text after it, up to `<!-- end -->`, is replaced.
"""

import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import tomllib

Spec = dict[str, Any]
ROOT = Path(__file__).parent.parent
SPECS: list[Spec] = []


def table(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join(f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def family(name: str) -> list[Spec]:
    """The environments whose ids contain a name, in any case."""
    return [spec for spec in SPECS if name.lower() in spec["id"].lower()]


def memory_gym() -> list[Spec]:
    """The environments of Memory Gym."""
    return [spec for spec in SPECS if not spec["id"].startswith("popgym-")]


def merged(specs: list[Spec], rows: Callable[[Spec], Iterable[tuple[str, ...]]]) -> list[tuple[str, ...]]:
    """The distinct rows of all environments, with a first column for the ids that have each."""
    ids: dict[tuple[str, ...], list[str]] = {}
    for spec in specs:
        for row in rows(spec):
            ids.setdefault(row, []).append(short(spec))
    return [("all" if len(names) == len(specs) else levels(names), *row) for row, names in ids.items()]


def levels(names: list[str]) -> str:
    """Ids, with the name of the family in place of its three difficulties."""
    return re.sub(r"(\w+)Easy, \1Medium, \1Hard", r"\1", ", ".join(names))


def short(spec: Spec) -> str:
    """An id without its version and POPGym's prefix."""
    return spec["id"].removesuffix("-v0").removeprefix("popgym-")


def overview(_: str) -> str:
    """Memory Gym's environments with links to their sections."""
    rows = []
    for spec in memory_gym():
        name = re.sub(r"Endless-|B?(-Grid)?-v0", "", spec["id"])
        page = re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name).lower()
        link = f"[`{spec['id']}`]({page}.md#{spec['id'].lower()})"
        rows.append((link, space(spec["action_space"]), spec["render_fps"], spec["summary"]))
    return table(["id", "actions", "frames per second", "task"], rows)


def space(described: dict[str, Any]) -> str:
    """A space as Gymnasium writes it."""

    def text(described: dict[str, Any]) -> str:
        ((kind, value),) = described.items()
        if kind == "Tuple":
            return f"Tuple({', '.join(map(text, value))})"
        if kind == "Box":
            bounds = [[value[end], sign] for end, sign in (("low", "-inf"), ("high", "inf"))]
            low, high = (sorted({sign if each is None else f"{each:.3g}" for each in given}) for given, sign in bounds)
            if len(low) == len(high) == 1:
                return f"Box({low[0]}, {high[0]}, ({len(value['low'])},))"
            return f"Box({[round(each, 3) for each in value['low']]}, {[round(each, 3) for each in value['high']]})"
        if kind == "MultiDiscrete" and len(set(value)) == 1 < len(value) - 2:
            return f"MultiDiscrete([{value[0]}] * {len(value)})"
        return f"{kind}({value})"

    return f"`{text(described)}`".replace(" ", "\N{NO-BREAK SPACE}")


def variants(name: str) -> str:
    """The ids of a family with their spaces; difficulties with the same spaces share a row."""
    ids: dict[tuple[str, ...], list[str]] = {}
    for each in family(name):
        key = (
            re.sub("(Easy|Medium|Hard)-", "", each["id"]),
            space(each["action_space"]),
            space(each["observation_space"]),
        )
        ids.setdefault(key, []).append(f"`{each['id']}`")
    return table(["ids", "actions", "observation"], ((", ".join(same), *spaces) for (_, *spaces), same in ids.items()))


def choices(name: str) -> str:
    """The meanings of an action's numbers in a family with one branch."""
    (branch,) = family(name)[0]["actions"]
    return table(
        ["action", "name", "meaning"],
        ((number, each["name"], each["description"]) for number, each in enumerate(branch["choices"])),
    )


def actions(_: str) -> str:
    """The meanings of an action's numbers, with a row for each branch."""

    def rows(spec: Spec) -> Iterable[tuple[str, ...]]:
        for branch, described in enumerate(spec["actions"]):
            place = f"`action[{branch}]`" if len(spec["actions"]) > 1 else "`action`"
            yield place, *(f"{choice['name']}: {choice['description']}" for choice in described["choices"])

    found = merged(memory_gym(), rows)
    most = max((row[0] for row in found), key=len)
    numbers = [str(number) for number in range(max(map(len, found)) - 2)]
    rest = [
        ("all others" if row[0] == most else row[0], *row[1:], *[""] * (len(numbers) + 2 - len(row))) for row in found
    ]
    return table(["ids", "branch", *numbers], rest)


def parameters(name: str) -> str:
    """Reset parameters with their limits, the default of each id, and their meaning."""
    specs = family(name)
    found: dict[tuple[str, str, str], dict[str, str]] = {}
    for spec in specs:
        for each in spec["parameters"]:
            key = (f"`{each['name']}`", allowed(each), each["description"])
            found.setdefault(key, {})[short(spec)] = f"`{json.dumps(each['default'])}`"
    if all(len(defaults) == len(specs) and len(set(defaults.values())) == 1 for defaults in found.values()):
        same = ((*key[:2], next(iter(defaults.values())), key[2]) for key, defaults in found.items())
        return table(["reset parameter", "allowed", "default", "meaning"], same)
    rows = [
        (parameter, limits, *(defaults.get(short(spec), "") for spec in specs), meaning)
        for (parameter, limits, meaning), defaults in found.items()
    ]
    return table(["reset parameter", "allowed", *map(short, specs), "meaning"], rows)


def arguments(name: str) -> str:
    """Arguments of the ids with their limits, the default of each id, and their meaning."""

    def rows(spec: Spec) -> Iterable[tuple[str, ...]]:
        for each in spec["arguments"]:
            yield f"`{each['name']}`", f"`{json.dumps(each['default'])}`", allowed(each), each["description"]

    return table(["ids", "argument", "default", "allowed", "meaning"], merged(family(name), rows))


def allowed(parameter: dict[str, Any]) -> str:
    """The values of a reset parameter, in words."""
    kind, limits = parameter["type"], (parameter.get("min"), parameter.get("max"))
    if kind in ("bool", "choice"):
        return " or ".join(parameter.get("choices", ("true", "false")))
    noun = {"int": "integer", "float": "number", "int_list": "list of integers"}[kind]
    if limits == (-(2**63), 2**63 - 1):
        return noun
    return f"{noun}, {' to '.join(f'{int(limit):,}' if limit == int(limit) else str(limit) for limit in limits)}"


def infos(name: str) -> str:
    """Infos of an episode's last step, in addition to those of all environments."""
    rows = merged(family(name), lambda spec: [(f"`{each['name']}`", each["description"]) for each in spec["info"]])
    return table(["ids", "info", "meaning"], rows)


def ground_truth(name: str) -> str:
    """The numbers of `info["ground_truth"]`, of the id of a family that has most."""
    columns = max((spec["ground_truth"] for spec in family(name)), key=len)
    places: dict[tuple[str, str], list[int]] = {}
    for place, each in enumerate(columns):
        places.setdefault((re.sub(r"\d+", "{}", each["name"]), each["description"]), []).append(place)
    rows = []
    for (template, meaning), same in places.items():
        names = f"`{ranges(template, [columns[place]['name'] for place in same])}`"
        rows.append((f"{same[0]} to {same[-1]}" if len(same) > 1 else same[0], names, meaning))
    return table(["index", "name", "meaning"], rows)


def features(name: str) -> str:
    """Columns of the feature observation; columns with the same meaning share a row."""

    def rows(spec: Spec) -> Iterable[tuple[str, ...]]:
        names: dict[tuple[str, str], list[str]] = {}
        for each in spec["features"]:
            names.setdefault((re.sub(r"\d+", "{}", each["name"]), each["description"]), []).append(each["name"])
        meanings: dict[str, list[str]] = {}
        for (template, meaning), same in names.items():
            meanings.setdefault(meaning, []).append(f"`{ranges(template, same)}`")
        return [(", ".join(each), meaning) for meaning, each in meanings.items()]

    return table(["ids", "feature", "meaning"], merged(family(name), rows))


def ranges(template: str, names: Sequence[str]) -> str:
    """`coin_{0..7}_x` for `coin_0_x` to `coin_7_x`."""
    if len(names) == 1:
        return names[0]
    places = zip(*(map(int, re.findall(r"\d+", name)) for name in names), strict=True)
    return template.format(*(f"{{{min(place)}..{max(place)}}}" for place in places))


#: Where a page lists the messages of error types.
ERRORS = re.compile(r"<!-- errors: ([\w ]+) -->")
#: A type that derives `thiserror::Error`: documentation, kind, name, and the rest up to the line that closes it.
ERROR_TYPE = re.compile(
    r"((?:^///[^\n]*\n)*)^#\[derive\([^)]*\bError\b[^)]*\)\]\n((?:^#\[.*?\]\n)*)^pub (enum|struct) (\w+)(.*?(?:^\}|;$))",
    re.M | re.S,
)
#: The arguments of an error attribute: the format string and the rest.
FORMAT = re.compile(r'#\[error\(\s*"((?:[^"\\]|\\.)*)"(.*?)\)\]\n', re.S)
#: Documentation, attribute, name and fields of a variant.
VARIANT = re.compile(
    r"((?:^    ///[^\n]*\n)+)(?:^    #\[(?!error)[^\n]*\n)*^    (#\[error\(.*?\)\]\n)(?:^    #\[[^\n]*\n)*^    (\w+)"
    r"( \{\n.*?^    \},$|[^\n]*$)",
    re.M | re.S,
)


def errors(names: str) -> str:
    """The messages of error types, each with its cause; those with the same help in `error_help.toml` share a line."""
    lines = []
    for name in names.split():
        variants, help = error_types().get(name, {}), HELP.get(name, {})
        if differing := variants.keys() ^ help.keys():
            raise SystemExit(f"docs/error_help.toml, [{name}]: not both an error and a help: {', '.join(differing)}")
        same: dict[str, list[str]] = {}
        for key, (text, reason) in variants.items():
            same.setdefault(help[key], []).append(f"`` {text} ``: {reason}")
        lines += [f"- {' '.join(described)} *Help:* {text}" for text, described in same.items()]
    return "\n".join(lines)


def error_types() -> dict[str, dict[str, tuple[str, str]]]:
    """Message and cause by error type and variant. Errors with no message of their own are left out."""
    types = {}
    for file in sorted((ROOT / "engine").glob("*/src/**/*.rs")):
        for doc, attributes, kind, name, body in ERROR_TYPE.findall(file.read_text()):
            described = [(doc, attributes, "self", body)] if kind == "struct" else VARIANT.findall(body)
            types[name] = {
                variant: (message(*found.groups(), fields), cause(doc))
                for doc, attribute, variant, fields in described
                if (found := FORMAT.search(attribute)) and found[1] != "{0}"
            }
    return types


def cause(doc: str) -> str:
    """The text of documentation comments, without rustdoc links, which do not work here."""
    text = " ".join(re.findall(r"/// ?(.*)", doc))
    return " ".join(re.sub(r"\[(`.+?`)\](\(.+?\))?", r"\1", text).split())


def message(text: str, arguments: str, fields: str) -> str:
    """The text of a format string, with names in angle brackets in place of values."""
    names = set(re.findall(r"(\w+):", fields))
    # Commas inside parentheses do not separate arguments.
    values = [part for part in re.split(r",(?![^(]*\))", arguments) if part.strip()]
    unnamed = iter(values)

    def placeholder(found: re.Match[str]) -> str:
        name = found[1].split(":")[0]
        if name and not (name.isdigit() and values):
            return f"<{name}>"
        value = values[int(name)] if name else next(unnamed, "").strip()
        word = next((word for word in re.findall(r"\w+", value) if word in names and " - " not in value), "...")
        return f" (process <{word}>)" if value.startswith("in_process") else f"<{word}>"

    text = re.sub(r"\\\n\s*", "", text).replace('\\"', '"')
    return re.sub(r"\{([^}]*)\}", placeholder, text)


HELP = tomllib.loads((ROOT / "docs/error_help.toml").read_text())
PARTS = {
    "environments": overview,
    "variants": variants,
    "choices": choices,
    "actions": actions,
    "parameters": parameters,
    "arguments": arguments,
    "infos": infos,
    "ground-truth": ground_truth,
    "features": features,
}


def main() -> None:
    """Write or check all pages."""
    SPECS.extend(json.load(sys.stdin))
    pages = {file: file.read_text() for file in sorted((ROOT / "docs").rglob("*.md"))}
    part = re.compile(r"(<!-- generated: ([\w-]+) ?([\w ]*?) -->\n).*?(<!-- end -->)", re.S)
    new = {
        file: part.sub(lambda found: f"{found[1]}\n{PARTS[found[2]](found[3])}\n\n{found[4]}", text)
        for file, text in pages.items()
    }
    described = " ".join(new.values())
    # A section, or a cell of a table.
    missing = [spec["id"] for spec in SPECS if not re.search(rf"## {spec['id']}\n|[|,] `{spec['id']}`[ ,]", described)]
    listed = set(" ".join(ERRORS.findall(described)).split())
    errors(" ".join(listed & error_types().keys()))
    missing += [name for name, found in error_types().items() if found and name not in listed]
    if missing or (missing := list(HELP.keys() - error_types().keys())):
        raise SystemExit(f"docs/ does not describe, or describes in vain: {', '.join(missing)}")
    stale = [str(file.relative_to(ROOT)) for file, text in pages.items() if new[file] != text]
    if "--check" not in sys.argv:
        for file, text in new.items():
            file.write_text(text)
    if stale:
        print("stale, run `cargo xtask docs --write`:" if "--check" in sys.argv else "written:", ", ".join(stale))
        sys.exit("--check" in sys.argv)


if __name__ == "__main__":
    main()
