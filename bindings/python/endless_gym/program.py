"""The program `endless`, as the package brings it along."""

import sys

from endless_gym import _native
from endless_gym.engine import program


def main() -> int:
    """Runs the program with this process's arguments."""
    return _native.endless(sys.argv[1:], program())
