"""`endless-train --view`: a page that shows the environments of a training run."""

import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from agents_helpers import small

from endless_gym_agents.environments.groups import Environments


def test_the_page_shows_the_runs_engine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = replace(small("gru", tmp_path / "run", 1, engine="process"), view=True)
    with Environments(settings) as environments:
        url = capsys.readouterr().out.split()[-1]
        with urllib.request.urlopen(url) as page:
            assert page.status == 200
            assert b"Endless Gym" in page.read()
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(url.split("?")[0])
        engine: Any = environments._envs._envs._engine  # type: ignore[union-attr]
        base, token = url.split("?token=")
        with urllib.request.urlopen(f"{base}{token}/engines") as engines:
            assert f'"service":"{engine.service}"'.encode() in engines.read()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(url)
