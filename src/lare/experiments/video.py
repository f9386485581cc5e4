"""An episode of a run's policy as a film, for one agent and for many."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from lare.errors import LareError
from lare.experiments import agents
from lare.experiments.evaluation import acting
from lare.tasks.episodic import EpisodicReward
from lare.tasks.particles.drawing import FRAMES_PER_SECOND
from lare.training.environments import Stream, episode_seed, make_episodic
from lare.training.run import Run

FRAME = {"width": 320, "height": 320}
"""Pixels of a MuJoCo film: its usual 480 by 480 take twice as long, and as much room."""


def record_video(run: Run, path: str | Path) -> None:
    """Film one episode of the first seed's policy, as a .gif, or as an .mp4 with the extra `lare-rl[video]`.

    Agents of particle tasks wear their credit, as number and colour.

    Raises:
        LareError: the environment cannot be drawn on this machine, or the file cannot be written.
    """
    path = Path(path)
    check_video(path)
    if run.config.task.particles:
        write_video(path, agents.frames(run), 1 / FRAMES_PER_SECOND)
        return
    camera = {"camera_name": "track", **FRAME} if has_tracking_camera(run) else {}
    with closing(make_episodic(run.config.task, render_mode="rgb_array", **camera)) as environment:
        fps = environment.metadata.get("render_fps", 30)
        # Browsers play a GIF at 50 frames a second at most, and a frame may take long where there is no graphics card.
        every = max(1, round(fps / 25)) if path.suffix == ".gif" else 1
        write_video(path, list(drawn(run, environment, every)), every / fps)


def drawn(run: Run, environment: EpisodicReward, every: int) -> Iterator[np.ndarray]:
    """Pictures of every so many steps of an episode. Raises `LareError` where this machine draws none."""
    act = acting(run, environment.action_space)
    observation, _ = environment.reset(seed=episode_seed(run.seeds[0], Stream.EVALUATION_EPISODES, 0))
    ended, step = False, 0
    while not ended:
        if step % every == 0:
            yield picture(environment)
        observation, _, terminated, truncated, _ = environment.step(act(observation))
        ended, step = terminated or truncated, step + 1


def picture(environment: EpisodicReward) -> np.ndarray:
    """The environment as it is now."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of graphics libraries that find no screen: another one may do without
            return np.asarray(environment.render())
    except Exception as error:  # a missing display shows itself in as many ways as there are graphics libraries
        raise LareError(
            f"{environment.spec.id if environment.spec else 'the environment'} cannot be drawn here: "
            f"{error}; without a screen, MUJOCO_GL=egl in the environment may help"
        ) from error


def has_tracking_camera(run: Run) -> bool:
    """Whether the environment is a MuJoCo model with a camera that follows it, which Gymnasium does not use by itself."""
    with closing(make_episodic(run.config.task)) as environment:
        model: Any = getattr(environment.unwrapped, "model", None)
        return hasattr(model, "ncam") and "track" in (model.camera(number).name for number in range(model.ncam))


def check_video(path: Path) -> None:
    """Raise `LareError` where a video could not be written, before the work is done."""
    if path.suffix not in (".gif", ".mp4"):
        raise LareError(f"{path} is no name of a video: it ends in .gif, or in .mp4 with the extra lare-rl[video]")
    if not path.parent.is_dir():
        raise LareError(f"the video {path} cannot be written: there is no directory {path.parent}")


def write_video(path: Path, frames: Sequence[np.ndarray], seconds: float) -> None:
    """Write pictures that are shown for so many seconds each. Raises `LareError` where that cannot be done."""
    import imageio.v3 as imageio

    timing: dict[str, Any] = {"duration": 1000 * seconds, "loop": 0} if path.suffix == ".gif" else {"fps": 1 / seconds}
    try:
        imageio.imwrite(path, list(frames), **timing)
    except (OSError, ValueError, ImportError, TypeError) as error:
        raise LareError(
            f"the video {path} cannot be written: {error}; .gif always works, .mp4 needs lare-rl[video]"
        ) from error
