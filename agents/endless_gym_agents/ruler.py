"""`python -m endless_gym_agents.ruler`."""

import sys

from endless_gym_agents.evaluation.ruler import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
