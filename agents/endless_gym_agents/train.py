"""`endless-train`, and the function `train`."""

import sys

from endless_gym_agents.training.train import main, train

__all__ = ["main", "train"]

if __name__ == "__main__":
    sys.exit(main())
