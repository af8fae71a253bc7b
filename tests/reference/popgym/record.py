"""Records episodes of the original; `python record.py OUT` writes the files of this folder.

`python record.py -` plays what it reads instead: one request per line, {"env", "seed", "episodes", "options"}. It answers
each with a line, the trace. `tests/integration/popgym.rs` runs it.
"""

import gzip
import json
import sys
from pathlib import Path
from typing import Any

from original import IDS, trace, wrapped

SEED = 20230501

#: Options other than the defaults, which only some ids have.
OPTIONS = {"Pole": {"low": -0.5, "high": 0.25}, "pole": {"low": -0.02}, "Pendulum": {"x_init": 0.5, "y_init": 4.0}}

#: Ids with all kinds of spaces, which are also recorded with POPGym's wrappers.
WRAPPED = [f"popgym-{name}Easy-v0" for name in ("Autoencode", "Battleship", "CountRecall", "PositionOnlyPendulum")]


def record() -> dict[str, list[dict[str, Any]]]:
    """The traces of each family: two for each id, the second with other options if the id has any."""
    families: dict[str, list[dict[str, Any]]] = {}
    for number, env_id in enumerate(IDS):
        family = env_id.removeprefix("popgym-").removesuffix("-v0")
        for level in ("Easy", "Medium", "Hard"):
            family = family.removesuffix(level)
        options = next((given for name, given in OPTIONS.items() if name in env_id), {})
        episodes = 2 if "Labyrinth" in env_id or "RepeatFirst" in env_id else 3
        traces = [trace(env_id, SEED + number, episodes, {})]
        traces.append(trace(env_id, 2**31 + number, 1, options))
        families.setdefault(family, []).extend(traces)
    return families


def main() -> None:
    if sys.argv[1] == "-":
        for line in sys.stdin:
            request = json.loads(line)
            answer = trace(request["env"], request["seed"], request["episodes"], request["options"])
            print(json.dumps(answer), flush=True)
        return
    files: dict[str, Any] = {**record(), "wrapped": {id: wrapped(id, SEED) for id in WRAPPED}}
    for name, content in files.items():
        text = json.dumps(content, separators=(",", ":"))
        path = Path(sys.argv[1]) / f"{name}.json.gz"
        path.write_bytes(gzip.compress(text.encode(), mtime=0))


if __name__ == "__main__":
    main()
