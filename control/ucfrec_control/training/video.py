"""Recording an episode as a video or as a folder of frames."""

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from matplotlib.image import imsave

from ucfrec.acting.rollout import rollout
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file, atomic_folder
from ucfrec_control.training.evaluate import choose_rule, environment_of, load_run, open_environment

Frame = npt.NDArray[np.uint8]
"""(height, width, 3)."""
Take = Callable[[Frame, float], None]
"""Called with a frame and the frames per second."""
_VIDEO = ".mp4"


def record_episode(
    run: Path,
    out: Path,
    *,
    seed: int,
    checkpoint: str,
    env_id: str | None,
    target: float | None,
    distractor: float = 0.0,
) -> float:
    """Roll out one episode, with the initial state of the first of `evaluate_run`, and keep its
    frames. InputError as `evaluate_run`, or `out` exists, or the environment cannot be rendered.

    Args:
        out: `NAME.mp4`, or a folder for `frame-00000.png`, …; the first frame is the initial state.
            It is written when the episode has ended.
        checkpoint, env_id, distractor: as of `evaluate_run`.
        target: target return; None for the preset's first.
    """
    if out.suffix not in ("", _VIDEO):
        raise InputError(
            f"{out} is neither an {_VIDEO} file nor a folder name without a dot; rename it"
        )
    if out.exists():
        raise InputError(f"{out} exists already; remove it or name another with --video")
    trained = load_run(run, checkpoint)
    environment = environment_of(trained, env_id)
    rule = choose_rule(trained, target, environment)
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    with (_video if out.suffix == _VIDEO else _frames)(out) as take:
        with _rendering(environment):
            how: dict[str, Any] = {"distractor": distractor, "render_mode": "rgb_array"}
            env = open_environment(trained, environment, 1, [partial(_Recorder, take=take)], **how)
        try:
            rolled_out = rollout(env, trained.actor(1, rule), 1, seed, describe="record episode")
        finally:
            env.close()
    return float(rolled_out.returns[0])


class _Recorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Hands every frame of the first episode to `take`."""

    def __init__(self, env: gymnasium.Env[Any, Any], take: Take) -> None:
        super().__init__(env)
        self._take = take
        self._ended = False

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        result = super().reset(**options)
        self._record()
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        outcome = super().step(action)
        self._record()
        self._ended = outcome[2] or outcome[3]
        return outcome

    def _record(self) -> None:
        if not self._ended:
            with _rendering(str(self.spec.id) if self.spec else "the environment"):
                frame = self.env.render()
            self._take(np.asarray(frame), self.metadata["render_fps"])


@contextmanager
def _rendering(environment: str) -> Iterator[None]:
    """Turn any error of rendering, for which OpenGL has no common class, into an InputError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"{environment} cannot be rendered ({reason}); install OpenGL (libegl1, or "
            "libosmesa6) and set MUJOCO_GL to egl, or osmesa"
        ) from error


@contextmanager
def _frames(out: Path) -> Iterator[Take]:
    with atomic_folder(out) as scratch:
        number = count()
        yield lambda frame, _: imsave(scratch / f"frame-{next(number):05d}.png", frame)


@contextmanager
def _video(out: Path) -> Iterator[Take]:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise InputError(
            f"{out} needs imageio-ffmpeg, which is not installed; install ucfrec[video], "
            "or name a folder for frames"
        ) from None
    with atomic_file(out) as scratch, ExitStack() as stack:
        writers: list[Any] = []

        def take(frame: Frame, fps: float) -> None:
            if not writers:
                size, form = (frame.shape[1], frame.shape[0]), ["-f", "mp4"]
                path = str(scratch)
                writer = imageio_ffmpeg.write_frames(path, size, fps=fps, output_params=form)
                writer.send(None)
                writers.append(stack.enter_context(closing(writer)))
            writers[0].send(np.ascontiguousarray(frame))

        yield take
