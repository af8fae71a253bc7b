"""Fail if files or rooms of a crate or a Python package import each other in a cycle, or a folder one above it.

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
FLOORS = [
    ["engine/core", "engine/memory-gym", "engine/popgym", "engine/service"],
    ["engine/*"],
    ["."],
    ["bindings/*"],
    ["agents"],
]
#: The Python packages with their floors, and their rooms, folders and files at their top, in the same order.
PACKAGES = {"bindings/python/endless_gym": 3, "agents/endless_gym_agents": 4}
ROOMS = [
    "_native arguments interop program specs experts display requests env statistics vector replay popgym episodes create "
    "registration pufferlib sb3 watching engine recording memory_gym torchrl cli",
    "popgym common settings memories environments agent training checkpoint train evaluation export ruler evaluate "
    "conformance paper",
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


def room_imports(imports: dict[Module, set[Module]], depth: int) -> dict[Module, set[Module]]:
    """For each room, a folder or a file at a depth, the rooms that it imports."""
    found: dict[Module, set[Module]] = {}
    for module, imported in imports.items():
        found.setdefault(module[:depth], set()).update({name[:depth] for name in imported} - {module[:depth]})
    return found


def upward_imports() -> Iterator[str]:
    """Crates and Python files of a floor that depend on a crate or a package of a higher one."""
    floors: dict[str, int] = {Path(package).name: floor for package, floor in PACKAGES.items()}
    manifests = {}
    for floor, patterns in enumerate(FLOORS):
        for path in sorted(path for pattern in patterns for path in Path().glob(f"{pattern}/Cargo.toml")):
            manifests[path] = tomllib.loads(path.read_text())
            floors.setdefault(manifests[path]["package"]["name"], floor)
    for path, manifest in manifests.items():
        own = floors[manifest["package"]["name"]]
        for kind in ("dependencies", "dev-dependencies", "build-dependencies"):
            yield from (f"{path}: {name}" for name in manifest.get(kind, {}) if floors.get(name, 0) > own)
    for package, own in PACKAGES.items():
        for path in Path(package).rglob("*.py"):
            imported = re.findall(r"^\s*(?:from|import) (\w+)", path.read_text(), re.MULTILINE)
            yield from (f"{path}: {name}" for name in imported if floors.get(name, 0) > own)


def upward_rooms() -> Iterator[str]:
    """Rooms of Python packages that import one above their own, or that are not in the list."""
    for package, names in zip(PACKAGES, ROOMS, strict=True):
        rooms = names.split()
        for (_, *room), imported in room_imports(python_imports(Path(package)), 2).items():
            above = rooms[rooms.index(room[0]) + 1 :] if room and room[0] in rooms else []
            yield from (f"{package}, {room[0]}: {name[1]}" for name in imported if name[1:] and name[1] in above)
            yield from (f"{package}: the unknown room {name}" for name in room[:1] if name not in rooms)


failed = False
for upward in (*upward_imports(), *upward_rooms()):
    failed = True
    print(f"{upward} is of a higher folder")
for folder, imports, depth in [
    *((crate, rust_imports(crate / "src"), 1) for crate in CRATES),
    *((Path(package), python_imports(Path(package)), 2) for package in PACKAGES),
]:
    try:
        TopologicalSorter(imports).prepare()
        TopologicalSorter(room_imports(imports, depth)).prepare()
    except CycleError as error:
        failed = True
        print(
            f"{folder}: its parts import each other in a cycle:",
            " <- ".join("/".join(name) or "lib" for name in error.args[1]),
        )
sys.exit(failed)
