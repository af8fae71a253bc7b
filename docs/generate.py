"""MkDocs hook: the parts of the documentation that follow from the sources.

`cargo xtask docs` writes the engine's table of environments and the messages of its errors as JSON into the folder
that ENDLESS_DOCS_DATA names. Pages have comments in the places where their parts are inserted.
"""

import ast
import json
import os
import re
import tomllib
from html import escape
from pathlib import Path

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).parent.parent
DATA = Path(os.environ["ENDLESS_DOCS_DATA"])
ENVIRONMENTS = {spec["id"]: spec for spec in json.loads((DATA / "environments.json").read_text())}
ERRORS = {error["type"]: error["variants"] for error in json.loads((DATA / "errors.json").read_text())}
CURES = tomllib.loads((ROOT / "docs/cures.toml").read_text())

#: Documents of the repository that are pages of the site, too.
PAGES = {
    "design/architecture.md": "ARCHITECTURE.md",
    "design/comparison.md": "benches/comparison.md",
    "reference/changes.md": "CHANGELOG.md",
    "train/learning.md": "benches/agents/learning/README.md",
}

FAMILIES = {
    "MortarMayhem": "Mortar Mayhem",
    "MysteryPath": "Mystery Path",
    "SearingSpotlights": "Searing Spotlights",
}


def on_files(files, config):
    """Adds the pages that are written elsewhere in the repository, with their pictures."""
    for page, source in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text()))
        for picture in (ROOT / source).parent.glob("*.png"):
            files.append(File.generated(config, f"{Path(page).parent}/{picture.name}", abs_src_path=str(picture)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Replaces comments such as `<!-- generated: parameters -->`."""
    path = Path(page.file.src_uri)

    def generated(found):
        kind, _, name = found[1].partition(" ")
        if kind == "environments":
            return overview(name)
        if kind == "errors":
            return errors(name)
        if kind == "python":
            return python_errors()
        return PARTS[kind](specification(path), files)

    if path.parent.name == "environments" and path.stem != "index":
        specification(path)
    return re.sub(r"<!-- generated: (.+?) -->", generated, markdown)


def on_nav(nav, config, files):
    """Every environment has a page, and every error a list of its cures."""
    missing = [id for id in ENVIRONMENTS if files.get_file_from_path(f"environments/{id}.md") is None]
    if missing:
        raise PluginError(f"no page docs/environments/ID.md for {', '.join(missing)}")
    text = (ROOT / "docs/operate/troubleshooting.md").read_text()
    unlisted = [
        name for name, variants in ERRORS.items() if variants and f"<!-- generated: errors {name} -->" not in text
    ]
    if unlisted:
        raise PluginError(f"docs/operate/troubleshooting.md has no list of {', '.join(unlisted)}")
    program = "".join(path.read_text() for path in (ROOT / "engine/cli/src").glob("*.rs"))
    table = text[text.index("## The program endless") :].split("<!--")[0]
    if old := [message for message in re.findall(r"^\| `(.+?)` \|", table, re.M) if message not in program]:
        raise PluginError(f"docs/operate/troubleshooting.md has messages that the program does not print: {old}")
    if unknown := CURES.keys() - ERRORS.keys():
        raise PluginError(f"docs/cures.toml has cures for errors that do not exist: {', '.join(unknown)}")


def on_post_build(config):
    """Nothing is loaded from elsewhere when a page is viewed."""
    loads = re.compile(
        r"""<(?:script|img|iframe|source)[^>]*\ssrc=["']?(https?:)?//|<link[^>]*rel=["']?(?:stylesheet|preconnect)[^>]*href=["']?(https?:)?//"""
    )
    for file in Path(config.site_dir).rglob("*.html"):
        if file.is_relative_to(Path(config.site_dir, "rust")):
            continue
        if found := loads.search(file.read_text()):
            raise PluginError(f"{file} loads something from elsewhere: {found[0]}")


def specification(path):
    """The table entry of a page on an environment."""
    if path.stem not in ENVIRONMENTS:
        raise PluginError(f"docs/{path} describes no environment; there are {', '.join(ENVIRONMENTS)}")
    return ENVIRONMENTS[path.stem]


def table(headings, rows):
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join(f"| {' | '.join(cell(text) for text in line)} |" for line in lines)


def cell(text):
    return str(text).replace("|", "\\|")


def code(value):
    return f"`{value}`"


def overview(family):
    """A table of the environments of a family, with links to their pages."""
    rows = [
        [f"[{id}]({id}.md)", code(actions(spec)), spec["summary"]] for id, spec in ENVIRONMENTS.items() if family in id
    ]
    return table(["id", "actions", "task"], rows)


def actions(spec):
    ((kind, choices),) = spec["action_space"].items()
    return f"{kind}({choices})"


def picture(spec, files):
    """The animation, where `cargo xtask pictures` has made it."""
    name = f"images/environments/{spec['id']}.webp"
    if files.get_file_from_path(name) is None:
        return ""
    return f"![An episode of {spec['id']}](../{name}){{ .environment }}"


def spaces(spec, files):
    """Actions, observation, ground truth and frame rate."""
    frame = "×".join(map(str, spec["observation_shape"]))
    observation = f"uint8 {frame}, indexed `[x][y][channel]`"
    if spec["vector_observation"]:
        observation = (
            f"a dict: `visual_observation`, {observation}; `vector_observation`, float32 {spec['vector_observation']}"
        )
    truth = f'float64 {spec["ground_truth"]}, in `info["ground_truth"]`' if spec["ground_truth"] else "none"
    rows = [
        ["action space", code(actions(spec))],
        ["observation", observation],
        ["ground truth", truth],
        ["frames per second, when shown to people", spec["render_fps"]],
    ]
    return table(["", ""], rows)


def parameters(spec, files):
    rows = [
        [code(each["name"]), code(json.dumps(each["default"])), allowed(each), each["description"]]
        for each in spec["parameters"]
    ]
    return table(["reset parameter", "default", "allowed", "meaning"], rows)


def allowed(parameter):
    """The values of a reset parameter, in words."""
    kind, low, high = parameter["type"], parameter.get("min"), parameter.get("max")
    if kind == "bool":
        return "true or false"
    noun = {"int": "integer", "float": "number", "int_list": "list of integers"}[kind]
    if (low, high) == (-(2**63), 2**63 - 1):
        return noun
    return f"{noun}, {number(low)} to {number(high)}"


def number(value):
    return f"{int(value):,}" if value == int(value) else str(value)


def infos(spec, files):
    common = [
        {"name": "reward", "description": "sum of the rewards of the episode"},
        {"name": "length", "description": "steps of the episode"},
    ]
    return table(["info", "meaning"], [[code(each["name"]), each["description"]] for each in common + spec["info"]])


def features(spec, files):
    """The columns; those that differ only in numbers, such as the places of a grid, share a row."""
    names = {}
    for each in spec["features"]:
        names.setdefault((re.sub(r"\d+", "{}", each["name"]), each["description"]), []).append(each["name"])
    rows = [[code(ranges(template, same)), meaning] for (template, meaning), same in names.items()]
    return table(["feature", "meaning"], rows)


def ranges(template, names):
    """`coin_{0..7}_x` for `coin_0_x` to `coin_7_x`."""
    numbers = zip(*(map(int, re.findall(r"\d+", name)) for name in names), strict=True)
    return template.format(
        *(f"{{{min(place)}..{max(place)}}}" if len(names) > 1 else place[0] for place in map(tuple, numbers))
    )


PARTS = {
    "picture": picture,
    "spaces": spaces,
    "parameters": parameters,
    "infos": infos,
    "features": features,
}


def errors(name):
    """The messages of an error type, each with its cause and its cure."""
    if name not in ERRORS:
        raise PluginError(f"there is no error type {name}")
    variants = ERRORS[name]
    cures = CURES.get(name, {})
    names = {each["name"] or "self" for each in variants}
    if names != cures.keys():
        differing = ", ".join(sorted(names ^ cures.keys()))
        raise PluginError(
            f"docs/cures.toml, [{name}]: an error without a cure, or a cure without an error: {differing}"
        )
    return "\n\n".join(entry(name, each, cures[each["name"] or "self"]) for each in variants)


def entry(type, variant, cure):
    anchor = "-".join(filter(None, [type, variant["name"]])).lower()
    cause = " ".join(re.sub(r"\[(`.+?`)\](\(.+?\))?", r"\1", variant["doc"]).split())
    return f'<code id="{anchor}">{literal(variant["message"])}</code>\n\n:   {cause}\n\n    **Cure.** {cure}'


def literal(message):
    """A message as HTML, with what Markdown would interpret escaped."""
    return re.sub(r"[`*_\[\]|]", lambda found: f"&#{ord(found[0])};", escape(message))


def python_errors():
    """The messages that the Python package raises itself, each with its exception."""
    rows = set()
    for path in sorted((ROOT / "bindings/python/endless_gym").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
                message = pattern(node.exc.args[0])
                if re.search("[a-z]{3}", re.sub("<.*?>", "", message)):
                    rows.add((code(ast.unparse(node.exc.func).split(".")[-1]), f"<code>{literal(message)}</code>"))
    return table(["exception", "message"], sorted(rows))


def pattern(message):
    """The text of a string with the expressions of an f-string in angle brackets."""
    if isinstance(message, ast.Constant):
        return str(message.value)
    if not isinstance(message, ast.JoinedStr):
        return ""
    parts = (
        f"<{expression(part.value)}>" if isinstance(part, ast.FormattedValue) else part.value for part in message.values
    )
    return "".join(parts)


def expression(value):
    """A short name of an f-string's expression."""
    return value.id if isinstance(value, ast.Name) else value.attr if isinstance(value, ast.Attribute) else "..."
