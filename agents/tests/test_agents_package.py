"""The package's metadata."""

from pathlib import Path

import endless_gym

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"


def test_version_is_that_of_the_environments() -> None:
    text = PYPROJECT.read_text()
    assert f'\nversion = "{endless_gym.__version__}"\n' in text
    assert f'\n    "endless-gym=={endless_gym.__version__}",\n' in text
