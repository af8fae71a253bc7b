"""Fail if files of a crate, or files or rooms of a Python package, import each other in a cycle, or a folder one above it.

Run `python xtask/cycles.py`.
"""

import ast
import re
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import tomllib

#: The folders with code, each of which uses only itself and those before it, in Rust and in Python.
FLOORS = ["engine", "src", "bindings", "agents"]
PACKAGES = ["bindings/python/endless_gym", "agents/endless_gym_agents"]
#: The rooms of each package, folders and some files at its top, in the same order.
ROOMS = [
    ["_native", "arguments", "specs", "display", "program", "requests", "vector", "recording", "cli"],
    ["common", "settings", "environments", "memories", "agent", "training", "evaluation", "paper"],
]
CRATES = [path.parent for path in sorted([*Path().glob("*/*/Cargo.toml"), Path("xtask/Cargo.toml")])]

Module = tuple[str, ...]

#: Comments, strings, visibilities, and test modules.
IGNORED = re.compile(
    r'pub\([^)]*\)|//[^\n]*|"(?:\\.|[^"\\])*"|^#\[cfg\([^\n]*test\b[^\n]*\n(?:pub )?mod \w+ \{.*?^\}',
    re.DOTALL | re.MULTILINE,
)
USE = re.compile(r"\buse\s+([^;]+);")
PATH = re.compile(r"\b(?:\w+::)+\w+")


def rust_files(folder: Path) -> Iterator[tuple[Module, str]]:
    """The modules of a crate with their text, without test files."""
    for path in folder.rglob("*.rs"):
        if not path.stem.endswith("tests"):
            parts = path.relative_to(folder).with_suffix("").parts
            yield (parts[:-1] if parts[-1] in ("lib", "main", "mod") else parts), IGNORED.sub("", path.read_text())


def flat(tree: str) -> list[list[str]]:
    """The paths of a tree of imports, such as `a::{b, c::d}`."""
    paths: list[list[str]] = []
    stack: list[list[str]] = [[]]
    words: list[str] = []
    for token in [*re.findall(r"\w+|[{},]", re.sub(r"\bas \w+", "", tree)), ","]:
        if token == "{":
            stack.append(stack[-1] + words)
            words = []
        elif token in ",}":
            if words:
                paths.append(stack[-1] + words)
            words = []
            if token == "}":
                stack.pop()
        else:
            words.append(token)
    return paths


def rust_imports(folder: Path) -> dict[Module, set[Module]]:
    """For each module of a crate, the modules that it uses; a folder's `mod.rs` is a module, too."""
    files = dict(rust_files(folder))
    # Includes folders without a file, whose modules are declared in the root.
    modules = {module[:depth] for module in files for depth in range(len(module) + 1)}
    found: dict[Module, set[Module]] = {}
    for module, text in files.items():
        paths = [path for tree in USE.findall(text) for path in flat(tree)]
        paths += [path.split("::") for path in PATH.findall(USE.sub("", text))]
        found[module] = set()
        for first, *rest in paths:
            if first == "crate":
                target: Module = ()
            elif first in ("self", "super"):
                target = module[:-1] if first == "super" else module
                while rest and rest[0] == "super":
                    target, rest = target[:-1], rest[1:]
            elif (*module, first) in modules:  # a module names its children without a prefix
                target = (*module, first)
            else:
                continue
            while rest and (*target, rest[0]) in modules:
                target, rest = (*target, rest[0]), rest[1:]
            if target in files:
                found[module].add(target)
        found[module].discard(module)
    return found


def python_imports(folder: Path) -> dict[Module, set[Module]]:
    """For each module of a package, the modules that it imports, including imports in functions and for types only."""
    files = {
        path.relative_to(folder.parent).with_suffix("").parts: path
        for path in folder.rglob("*.py*")
        if path.suffix in (".py", ".pyi")
    }

    def named(parts: Module) -> Module:
        return parts[:-1] if parts[-1] == "__init__" else parts

    modules = {named(parts) for parts in files}
    found: dict[Module, set[Module]] = {}
    for parts, path in files.items():
        imported = found.setdefault(named(parts), set())
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {tuple(alias.name.split(".")) for alias in node.names} & modules
            elif isinstance(node, ast.ImportFrom):
                origin = (
                    *(parts[: -node.level] if node.level else ()),
                    *(node.module.split(".") if node.module else ()),
                )
                # A name that is not a module belongs to the module that it is imported from.
                targets = {(*origin, alias.name) for alias in node.names}
                imported |= {target if target in modules else origin for target in targets} & modules
        imported.discard(named(parts))
    return found


def room_imports(folder: Path) -> dict[Module, set[Module]]:
    """For each room of a package, a folder or a file at its top, the rooms that it imports."""
    found: dict[Module, set[Module]] = {}
    for module, imported in python_imports(folder).items():
        found.setdefault(module[:2], set()).update({name[:2] for name in imported} - {module[:2]})
    return found


def upward_imports() -> Iterator[str]:
    """Crates and Python files of a floor that depend on a crate or a package of a higher one."""
    crates = {
        tomllib.loads(path.read_text())["package"]["name"]: floor for floor in FLOORS for path in manifests(floor)
    }
    packages = {Path(package).name: package.split("/")[0] for package in PACKAGES}
    for floor in FLOORS:
        above = FLOORS[FLOORS.index(floor) + 1 :]
        for path in manifests(floor):
            manifest = tomllib.loads(path.read_text())
            for kind in ("dependencies", "dev-dependencies", "build-dependencies"):
                yield from (f"{path}: {name}" for name in manifest.get(kind, {}) if crates.get(name) in above)
        for package in PACKAGES:
            if package.startswith(floor):
                for path in Path(package).rglob("*.py"):
                    imported = re.findall(r"^\s*(?:from|import) (\w+)", path.read_text(), re.MULTILINE)
                    yield from (f"{path}: {name}" for name in imported if packages.get(name) in above)


def upward_rooms() -> Iterator[str]:
    """Rooms of Python packages that import one above their own."""
    for package, rooms in zip(PACKAGES, ROOMS, strict=True):
        for (_, *room), imported in room_imports(Path(package)).items():
            above = rooms[rooms.index(room[0]) + 1 :] if room and room[0] in rooms else []
            yield from (f"{package}, {room[0]}: {name[1]}" for name in imported if name[1:] and name[1] in above)


def manifests(floor: str) -> list[Path]:
    """The manifests of a floor's crates; that of `src` is the root's."""
    return [Path("Cargo.toml")] if floor == "src" else sorted(Path(floor).glob("*/Cargo.toml"))


failed = False
for upward in (*upward_imports(), *upward_rooms()):
    failed = True
    print(f"{upward} is of a higher folder")
for folder, imports in [
    *((Path(crate, "src"), rust_imports) for crate in CRATES),
    *((Path(package), imports) for package in PACKAGES for imports in (python_imports, room_imports)),
]:
    try:
        TopologicalSorter(imports(folder)).prepare()
    except CycleError as error:
        failed = True
        print(
            f"{folder}: its parts import each other in a cycle:",
            " <- ".join("/".join(name) or "lib" for name in error.args[1]),
        )
sys.exit(failed)
