"""`python -m endless_gym_agents.export`."""

import sys

from endless_gym_agents.evaluation.export import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
