"""The command lines of all programs."""

from collections.abc import Callable
from operator import attrgetter
from typing import Any

import pytest

from endless_gym_agents.common import command
from endless_gym_agents.evaluation import compare, enjoy, plot
from endless_gym_agents.paper import reproduce, search
from endless_gym_agents.training import train


def of(arguments: type, *first: str) -> Callable[[list[str]], Any]:
    return lambda given: command.parse(arguments, "program", "", [*first, *given])


@pytest.mark.parametrize(
    ("parse", "flag", "given", "expected"),
    [
        (train.parse, "--environment.option", ("show_goal=true", "a=[1, 2]"), ("show_goal=true", "a=[1, 2]")),
        (search.parse, "--environment.option", ("show_goal=true", "a=1"), ("show_goal=true", "a=1")),
        (search.parse, "--parameters", ("ppo.gamma", "ppo.epochs"), ("ppo.gamma", "ppo.epochs")),
        (of(enjoy.EnjoyArguments, "run"), "--seeds", ("3", "4"), (3, 4)),
        (of(plot.PlotArguments), "--published", ("gru", "trxl"), ("gru", "trxl")),
        (of(plot.PlotArguments), "--env", ("A", "B"), ("A", "B")),
        (of(compare.CompareArguments), "--range", ("a=0,1", "b=0,1"), ("a=0,1", "b=0,1")),
        (of(reproduce.ReproduceArguments), "--seeds", ("1", "2"), (1, 2)),
    ],
)
def test_the_values_of_a_repeated_flag_accumulate(
    parse: Callable[[list[str]], Any], flag: str, given: tuple[str, str], expected: tuple[Any, ...]
) -> None:
    one, two = given
    for arguments in ([flag, one, flag, two], [f"{flag}={one}", f"{flag}={two}"], [flag, one, two]):
        parsed = parse(arguments)
        if parse is search.parse and flag == "--environment.option":
            parsed = parsed.settings
        assert attrgetter(flag.removeprefix("--").replace("-", "_"))(parsed) == expected


def test_other_arguments_keep_their_order() -> None:
    given = ["a", "--x", "1", "--y=2", "-v", "--x=3", "--x", "4", "--z"]
    assert command.joined({"--x"}, given) == ["a", "--x", "1", "3", "4", "--y=2", "-v", "--z"]
