"""Videos of episodes and plots of learning curves."""

import csv
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from agents_helpers import settings
from numpy.typing import NDArray
from PIL import Image

from endless_gym.env import Env
from endless_gym.specs import spec
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.common.palette import AGENTS
from endless_gym_agents.evaluation import enjoy, plot, video
from endless_gym_agents.evaluation.curves import aggregate, evaluated, published, scale
from endless_gym_agents.evaluation.plot import PlotArguments, draw_all
from endless_gym_agents.evaluation.results import Experiment, Run, to_json
from endless_gym_agents.training.train import train

GRID = "MortarMayhem-Grid-v0"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    environment, ppo = {"num_envs": 4, "option": ("command_count=[1]",)}, {"steps": 16, "minibatches": 1, "updates": 2}
    return train(settings("gru", env=GRID, run=str(folder), threads=1, environment=environment, ppo=ppo))


def rgb(image: Image.Image) -> np.ndarray:
    return np.asarray(image.convert("RGB"))


def test_frame_shows_the_picture_next_to_the_view() -> None:
    frame = np.zeros((84, 84, 3), np.uint8)
    frame[20, 10] = (255, 0, 0)
    view = np.random.default_rng(0).integers(256, size=(336, 336, 3), dtype=np.uint8)
    picture = video.compose(frame, view, "one line")
    assert picture.shape == (video.HEIGHT, video.WIDTH, 3)
    assert (picture[80:84, 40:44] == (255, 0, 0)).all()
    assert (picture[:336, :336] == (255, 0, 0)).all(-1).sum() == 16
    assert (picture[:336, 344:] == view).all()
    assert (picture[336:] == video._TEXT_COLOUR).all(-1).any()


def test_webp_shows_the_episodes(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "video.webp"
    enjoy.execute(enjoy.EnjoyArguments(run, seeds=(200_000, 200_003), out=out))
    lengths = [int(line.split(" in ")[1].split()[0]) for line in capsys.readouterr().out.splitlines()[:2]]
    assert min(lengths) > 0
    with Image.open(out) as image:
        assert image.size == (video.WIDTH, video.HEIGHT)
        # One frame for the start and for each step; the last one of an episode stays for a second.
        fps = spec(GRID).render_fps
        assert image.n_frames == sum(lengths) + 2 + 2 * fps
        for place, seed in ((0, 200_000), (lengths[0] + 1 + fps, 200_003)):
            env = Env(GRID, render_mode="debug_rgb_array", options={"command_count": [1]})
            observation, _ = env.reset(seed=seed)
            image.seek(place)
            shown = rgb(image)
            assert (shown[:336:4, :336:4] == observation.swapaxes(0, 1)).all()
            assert (shown[:336, 344:] == env.render()).all()
        assert image.info["duration"] == pytest.approx(1000 / fps, abs=1)  # in milliseconds
    assert [file.name for file in tmp_path.iterdir()] == ["video.webp"]


def test_video_is_reproducible() -> None:
    agent = make_agent(settings("none", env=GRID), spec(GRID))
    one, two, other = (
        np.stack(list(enjoy.EpisodeRecorder(agent, action_seed, max_steps=12).frames((5,))))
        for action_seed in (0, 0, 1)
    )
    assert np.array_equal(one, two)
    assert one.shape != other.shape or not np.array_equal(one, other)


@pytest.mark.parametrize(
    ("name", "frames", "message"),
    [
        ("video.gif", 1, "name must end in .webp or .mp4, got `.*video.gif`"),
        ("none/video.webp", 1, "cannot write .*none/video.webp: No such file"),
        ("video.mp4", 1, "an .mp4 needs ffmpeg, and there is no program `ffmpeg`"),
        ("video.webp", 0, "a film needs at least one frame"),
        ("video.webp", 2, r"all frames uint8 \(height, width, 3\) of one size, got 25 and \[4, 6, 3\]"),
        ("video.webp", 3, "interrupted"),
    ],
)
def test_failed_video_leaves_no_file(
    name: str, frames: int, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))  # without ffmpeg
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for count in range(frames):
            if count == 2:
                raise KeyboardInterrupt("interrupted")
            yield np.zeros((4, 5 + count * (frames == 2), 3), np.uint8)

    with pytest.raises((OSError, ValueError, KeyboardInterrupt), match=message):
        video.write(tmp_path / name, pictures(), 25)
    assert list(tmp_path.iterdir()) == []


def experiment(env: str, name: str, label: str, scores: list[list[float]]) -> Experiment:
    """With checkpoints at 10, 20, ... steps."""
    steps = [10 * (place + 1) for place in range(len(scores[0]))]
    rows = enumerate(scores)
    runs = [Run(f"run-{seed}", seed, steps, {name: row}, [[{name: each}] for each in row]) for seed, row in rows]
    return Experiment(env, label, {}, runs)


def results(file: Path, *experiments: Experiment) -> Path:
    file.write_text(json.dumps(to_json(experiments, {}, True)))
    return file


def test_plots_contain_the_given_curves(tmp_path: Path) -> None:
    scores = [[0.0, 0.2, 0.5], [0.2, 0.4, 0.7]]
    file = results(tmp_path / "results.json", experiment("MysteryPath-v0", "task_progress", "gru", scores))
    (picture,) = draw_all(PlotArguments((file,), tmp_path / "plots", published=("trxl",)))
    with Image.open(picture) as image:
        assert image.size == (1350, 750)
        colours = {colour for _, colour in image.convert("RGB").getcolors(1 << 20)}
        both = {tuple(bytes.fromhex(AGENTS[agent][0][1:])) for agent in ("gru", "trxl")}
        assert both <= colours
    rows = list(csv.DictReader(picture.with_suffix(".csv").open()))
    ours = [row for row in rows if row["source"] == "evaluated"]
    assert [int(row["steps"]) for row in ours] == [10, 20, 30]
    assert [float(row["mean"]) for row in ours] == pytest.approx([0.1, 0.3, 0.6])
    assert [float(row["low"]) for row in ours] == pytest.approx([0.0, 0.2, 0.5])
    assert [float(row["high"]) for row in ours] == pytest.approx([0.2, 0.4, 0.7])
    mine, theirs = json.loads(picture.with_suffix(".json").read_text())["curves"]
    assert (mine["label"], mine["scores"]) == ("gru", scores)
    (trxl,) = published("MysteryPath-v0", ["trxl"])
    assert (theirs["source"], theirs["scores"]) == ("published", trxl.scores.tolist())
    assert sum(row["source"] == "published" for row in rows) == trxl.scores.shape[1] == 51


def test_a_task_with_other_options_is_not_compared_silently(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paper = experiment("MysteryPath-v0", "task_progress", "gru", [[0.5]])
    other = replace(paper, options={"max_steps": 60})
    for number, (one, warned) in enumerate(((paper, False), (other, True))):
        file = results(tmp_path / f"{number}.json", one)
        draw_all(PlotArguments((file,), tmp_path / str(number), published=("trxl",)))
        error = capsys.readouterr().err
        assert ("gru, max_steps=60 is another task than the paper's" in error) == warned
        draw_all(PlotArguments((file,), tmp_path / str(number), published=()))
        assert not capsys.readouterr().err


def test_a_plot_does_not_overwrite_the_results_that_it_shows(tmp_path: Path) -> None:
    file = results(tmp_path / "MysteryPath-v0.json", experiment("MysteryPath-v0", "task_progress", "gru", [[0.5]]))
    before = file.read_bytes()
    with pytest.raises(ValueError, match=r"cannot write .*MysteryPath-v0\.json"):
        draw_all(PlotArguments((file,), tmp_path))
    assert file.read_bytes() == before and list(tmp_path.iterdir()) == [file]


def test_spreads_runs_and_iqm(tmp_path: Path) -> None:
    scores = [[0.0], [0.1], [0.2], [0.3], [1.0]]
    file = results(tmp_path / "results.json", experiment("MysteryPath-v0", "task_progress", "gru", scores))
    (picture,) = draw_all(PlotArguments((file,), tmp_path, published=(), spread="runs"))
    rows = list(csv.DictReader(picture.with_suffix(".csv").open()))
    assert [[float(row["score"])] for row in rows] == scores
    (picture,) = draw_all(PlotArguments((file,), tmp_path, published=(), spread="iqm"))
    (row,) = csv.DictReader(picture.with_suffix(".csv").open())
    assert float(row["iqm"]) == pytest.approx(0.2)
    assert float(row["low"]) < 0.2 < float(row["high"])


def test_aggregated_curves_match_the_text_of_the_paper() -> None:
    """The paper states peaks of 0.98 (GRU) and 0.39 (Transformer-XL) in the endless tasks; for finite ones see `expected`."""
    peaks = {}
    for family, envs in plot.FAMILIES.items():
        curves = [curve for env in envs for curve in published(env, ("gru", "trxl", "gru_rec", "trxl_rec"))]
        together = aggregate(family, curves)
        assert all(curve.scores.shape[0] == 15 for curve in together)
        peaks[family] = {curve.label: curve.mean()[0].max() for curve in together}
    assert peaks["endless"] == {"gru": pytest.approx(0.98, abs=0.006), "trxl": pytest.approx(0.39, abs=0.006)}
    expected = {"gru": 0.83, "trxl": 0.56, "gru_rec": 0.82, "trxl_rec": 0.99}
    assert peaks["finite"] == {name: pytest.approx(value, abs=0.006) for name, value in expected.items()}


def test_evaluations_are_normalised_like_the_paper(tmp_path: Path) -> None:
    best = {env: scale(env) for env in plot.FAMILIES["endless"]}
    # According to the paper, the mean of the five GRU runs is at best 115 commands.
    assert best["Endless-MortarMayhem-v0"] == pytest.approx(115.8, abs=0.1)
    names = ("commands_completed", "tiles_visited", "coins_collected")
    labels = ("gru", "gru", "gru_rec")  # as in the paper's plot
    given = [
        experiment(env, name, label, [[best[env] / 2, best[env]], [0.0, best[env] / 4]])
        for env, name, label in zip(best, names, labels, strict=True)
    ]
    file = results(tmp_path / "results.json", *given)
    (picture,) = draw_all(PlotArguments((file,), tmp_path, aggregate="endless", published=()))
    (curve,) = json.loads(picture.with_suffix(".json").read_text())["curves"]
    assert (curve["label"], curve["steps"]) == ("gru", [10, 20])
    assert np.allclose(curve["scores"], 3 * [[0.5, 1.0], [0.0, 0.25]])


def test_curve_has_the_common_steps_of_its_runs() -> None:
    given = experiment("MysteryPath-v0", "task_progress", "gru", [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    given.runs[1].steps = [20, 30, 40]
    curve = evaluated(given)
    assert curve.steps.tolist() == [20, 30]
    assert curve.scores.tolist() == [[0.2, 0.3], [0.4, 0.5]]


def test_training_rewards(run: Path, tmp_path: Path) -> None:
    (picture,) = draw_all(PlotArguments((run,), tmp_path))
    (curve,) = json.loads(picture.with_suffix(".json").read_text())["curves"]
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    assert curve["steps"] == [row["steps"] for row in rows]
    assert curve["scores"] == [[row["episode/reward"] for row in rows]]
