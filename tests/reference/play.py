"""Plays given actions in the original and prints the trace; `tests/integration/live.rs` runs it.

Reads one request per line: {"env", "options", "views", "episodes": [{"seed", "actions"}]}. Answers each with one line:
a trace in the format of README.md, or {"error": text} if the original raises.
"""

import json
import sys
from typing import Any

from original import Original


def play(request: dict[str, Any]) -> dict[str, Any]:
    """Return the trace of the requested episodes."""
    original = Original(request["env"], request["options"])
    episodes = []
    for wanted in request["episodes"]:
        actions = (action[0] if len(action) == 1 else action for action in wanted["actions"])
        episodes.append(original.episode(wanted["seed"], actions, request["views"]))
    return {"env": request["env"], "options": request["options"], "episodes": episodes}


for line in sys.stdin:
    try:
        answer = play(json.loads(line))
    except Exception as error:  # Some combinations of options make the original raise; the caller decides.
        answer = {"error": f"{type(error).__name__}: {error}"}
    print(json.dumps(answer), flush=True)
