"""Error messages with their cures, for the page on troubleshooting."""

import ast
import json
import re
from html import escape
from pathlib import Path

import tomllib
from mkdocs.exceptions import PluginError
from tables import table

PAGE = "docs/operate/troubleshooting.md"


class Messages:
    """The messages of the engine's typed errors, of the program and of the Python package."""

    def __init__(self, root: Path, errors: Path) -> None:
        """Read the errors that `cargo xtask docs` found in the sources, and their cures."""
        self.root = root
        self.errors = {error["type"]: error["variants"] for error in json.loads(errors.read_text())}
        self.cures = tomllib.loads((root / "docs/cures.toml").read_text())

    def check(self) -> None:
        """Fail if an error is not listed, or what is listed does not exist."""
        page = (self.root / PAGE).read_text()
        for name, variants in self.errors.items():
            if variants and f"<!-- generated: errors {name} -->" not in page:
                raise PluginError(f"{PAGE} does not list the error type {name}")
        if unknown := self.cures.keys() - self.errors.keys():
            raise PluginError(f"docs/cures.toml has cures for errors that do not exist: {', '.join(unknown)}")
        program = "".join(file.read_text() for file in (self.root / "engine/cli/src").glob("*.rs"))
        listed = re.search(r"^## The program endless$(.+?)^<!--", page, re.M | re.S)
        for message in re.findall(r"^\| `(.+?)` \|", listed[1] if listed else "", re.M):
            if message not in program:
                raise PluginError(f"{PAGE} lists a message that the program does not print: {message}")

    def of_type(self, name: str) -> str:
        """The messages of an error type, each with its cause and its cure."""
        variants, cures = self.errors.get(name, []), self.cures.get(name, {})
        differing = {variant["name"] or "self" for variant in variants} ^ cures.keys()
        if differing:
            what = ", ".join(sorted(differing))
            raise PluginError(f"docs/cures.toml, [{name}]: an error without a cure, or a cure without an error: {what}")
        return "\n\n".join(entry(name, variant, cures[variant["name"] or "self"]) for variant in variants)

    def of_python(self) -> str:
        """The messages that the Python package raises itself, each with its exception."""
        rows = set()
        for file in (self.root / "bindings/python/endless_gym").rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
                    message = pattern(node.exc.args[0])
                    # Not those that pass on the message of another error.
                    if re.search("[a-z]{3}", re.sub("<.*?>", "", message)):
                        exception = ast.unparse(node.exc.func).split(".")[-1]
                        rows.add((f"`{exception}`", f"<code>{literal(message)}</code>"))
        return table(["exception", "message"], sorted(rows))


def entry(type: str, variant: dict[str, str], cure: str) -> str:
    """One message as an item of a definition list."""
    anchor = "-".join(filter(None, [type, variant["name"]])).lower()
    # Links of Rust's documentation lead nowhere here.
    cause = " ".join(re.sub(r"\[(`.+?`)\](\(.+?\))?", r"\1", variant["doc"]).split())
    return f'<code id="{anchor}">{literal(variant["message"])}</code>\n\n:   {cause}\n\n    **Cure.** {cure}'


def literal(message: str) -> str:
    """A message as HTML, with what Markdown would interpret escaped."""
    return re.sub(r"[`*_\[\]|]", lambda found: f"&#{ord(found[0])};", escape(message))


def pattern(message: ast.expr) -> str:
    """The text of a string, with names in angle brackets for the expressions of an f-string."""
    if isinstance(message, ast.Constant):
        return str(message.value)
    if not isinstance(message, ast.JoinedStr):
        return ""
    return "".join(
        f"<{short(part.value)}>" if isinstance(part, ast.FormattedValue) else pattern(part) for part in message.values
    )


def short(value: ast.expr) -> str:
    """A name for an expression."""
    if isinstance(value, ast.Name):
        return value.id
    return value.attr if isinstance(value, ast.Attribute) else "..."
