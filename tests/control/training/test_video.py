"""Frames and videos of an episode: what they show, and that nothing is half-written."""

import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from tests.support.control_files import changed, control, refused
from ucfrec.errors import InputError
from ucfrec_control.environments.environments import make_env
from ucfrec_control.training.evaluate import evaluate_run
from ucfrec_control.training.video import record_episode

SMALL = {"width": 64, "height": 48, "max_episode_steps": 4}


@pytest.fixture(scope="module")
def run(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose data is of a Hopper of four steps, drawn small."""
    to = tmp_path_factory.mktemp("video") / "run"
    return changed(folder / "store-run", to, ("data", "env_settings"), SMALL)


def record(run: Path, out: Path) -> float:
    try:
        return record_episode(run, out, seed=0, checkpoint="last", env_id=None, target=None)
    except InputError as error:
        if "cannot be rendered" in str(error):
            pytest.skip("no OpenGL here")
        raise


def test_frames_show_the_first_episode_from_its_start(run: Path, tmp_path: Path) -> None:
    earned = record(run, tmp_path / "frames")
    files = sorted((tmp_path / "frames").iterdir())
    assert [file.name for file in files] == [f"frame-0000{i}.png" for i in range(5)]
    frames = np.array([imread(file)[..., :3] for file in files])
    assert frames.shape == (5, 48, 64, 3)
    assert (frames[1:] != frames[:-1]).any(axis=(1, 2, 3)).all()
    env = make_env("Hopper-v5", 1, settings=SMALL | {"render_mode": "rgb_array"})
    env.reset(seed=0)
    (start,) = env.render()  # type: ignore[misc]
    env.close()
    np.testing.assert_array_equal(np.round(255 * frames[0]), start)
    (row,) = evaluate_run(run, episodes=1, seed=0, targets=(3600.0,), checkpoints=("last",))
    assert (row["length"], row["return"]) == (4, pytest.approx(earned))
    with pytest.raises(InputError, match="exists already"):
        record(run, tmp_path / "frames")


def test_a_video_has_the_frames_at_the_speed_of_the_environment(run: Path, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    earned = record(run, tmp_path / "a.mp4")
    read = ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    about = next(read)
    assert (about["size"], about["fps"], sum(1 for _ in read)) == ((64, 48), 125, 5)
    asked = ("--episodes", 1, "--checkpoint", "last", "--video", tmp_path / "b.mp4")
    assert f"b.mp4: an episode of return {earned:.1f}" in control("evaluate", run, *asked)[0]
    assert (tmp_path / "b.mp4").read_bytes() == (tmp_path / "a.mp4").read_bytes()


# Gymnasium's renderer is not up to its own deletion where it could not start.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("runs", "out", "says"),
    [
        (1, "a.gif", "neither an .mp4 file"),
        (2, "frames", "--video records one run; 2 were given"),
        (1, "without-ffmpeg.mp4", "install ucfrec[video], or name a folder"),
        (1, "without-opengl", "cannot be rendered"),
    ],
)
def test_what_cannot_be_shown_is_refused_and_leaves_nothing(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs: int, out: str, says: str
) -> None:
    if "opengl" in out:
        monkeypatch.setenv("MUJOCO_GL", "nothing")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert says in refused("evaluate", *[run] * runs, "--video", tmp_path / out)
    assert not list(tmp_path.iterdir())
