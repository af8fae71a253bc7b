"""`python -m endless_gym_agents.conformance`."""

import sys

from endless_gym_agents.evaluation.conformance import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
