"""An episode of a run's policy as a film, for one agent and for many."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lare_rl.envs.families import env_spec, make_host_env
from lare_rl.envs.gymnasium_env import GymnasiumEnv
from lare_rl.envs.interface import HostEnv
from lare_rl.errors import LareError
from lare_rl.evaluation import team_matches as agents
from lare_rl.evaluation.policy import Policy
from lare_rl.evaluation.watch import watch
from lare_rl.runs.directory import Run
from lare_rl.training.streams import Stream, episode_seed

FRAMES_PER_SECOND = 8
"""The frame rate of a film of many agents."""

FRAME = {"width": 320, "height": 320}
"""Pixels of a MuJoCo film. The default, 480 by 480, takes twice the time and space."""


def record_video(run: Run, path: str | Path, best: bool = False, deterministic: bool = False) -> None:
    """Film one episode of the first seed's policy, the last or the best, as a .gif, or as an .mp4 with the extra `lare-rl[video]`.

    A film of a particle task shows each agent's credit, as number and colour.

    Raises:
        LareError: the environment cannot be drawn on this machine, or the file cannot be written.
    """
    path = Path(path)
    check_video(path)
    if env_spec(run.config.task).agents > 1:
        if best or deterministic:
            raise LareError(
                "many agents are filmed as they act in training, with their credit: leave best and deterministic out"
            )
        pictures = agents.frames(run, watch(run))
        if pictures is None:
            raise LareError(f"{run.config.task.name} steps on the host, where only single agents are filmed")
        write_video(path, pictures, 1 / FRAMES_PER_SECOND)
        return
    camera = {"camera_name": "track", **FRAME} if has_tracking_camera(run) else {}
    with closing(make_host_env(run.config.task, render_mode="rgb_array", **camera)) as environment:
        assert isinstance(environment, GymnasiumEnv)
        fps = environment.environment.metadata.get("render_fps", 30)
        # Browsers play a GIF at 50 frames a second at most, and a frame may take long where there is no graphics card.
        every = max(1, round(fps / 25)) if path.suffix == ".gif" else 1
        policy = Policy(run, 0, best, deterministic)
        write_video(path, list(drawn(run, environment, every, policy)), every / fps)


def drawn(run: Run, environment: HostEnv, every: int, policy: Policy) -> Iterator[np.ndarray]:
    """Pictures of an episode, one in `every` steps. Raises `LareError` if this machine cannot draw them."""
    shown = environment.reset(episode_seed(run.seeds[0], Stream.EVALUATION_EPISODES, 0))
    ended, step = False, 0
    while not ended:
        if step % every == 0:
            yield picture(environment, run)
        shown = environment.step(policy.row(shown.observation[0])[None])
        ended, step = bool(shown.terminated or shown.truncated), step + 1


def gif(file: BytesIO, frames: Sequence[np.ndarray]) -> None:
    """Write pictures of many agents as an animated GIF."""
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(file, format="GIF", save_all=True, append_images=others, duration=1000 // FRAMES_PER_SECOND, loop=0)


def picture(environment: HostEnv, run: Run) -> np.ndarray:
    """The environment as it is now."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of graphics libraries that find no screen; another one may not need it
            return np.asarray(environment.render())
    except Exception as error:  # every graphics library has its own error for a missing display
        raise LareError(
            f"{run.config.task.environment} cannot be drawn here: "
            f"{error}; without a screen, MUJOCO_GL=egl in the environment may help"
        ) from error


def has_tracking_camera(run: Run) -> bool:
    """Whether the environment is a MuJoCo model with a camera that follows it, which Gymnasium does not use by itself."""
    with closing(make_host_env(run.config.task)) as environment:
        assert isinstance(environment, GymnasiumEnv)
        model: Any = getattr(environment.environment.unwrapped, "model", None)
        return hasattr(model, "ncam") and "track" in (model.camera(number).name for number in range(model.ncam))


def check_video(path: Path) -> None:
    """Raise `LareError` if a video could not be written, before the work is done."""
    if path.suffix not in (".gif", ".mp4"):
        raise LareError(f"{path} is no name of a video: it ends in .gif, or in .mp4 with the extra lare-rl[video]")
    if not path.parent.is_dir():
        raise LareError(f"the video {path} cannot be written: there is no directory {path.parent}")


def write_video(path: Path, frames: Sequence[np.ndarray], seconds: float) -> None:
    """Write pictures that are shown for so many seconds each. Raises `LareError` if that fails."""
    import imageio.v3 as imageio

    timing: dict[str, Any] = {"duration": 1000 * seconds, "loop": 0} if path.suffix == ".gif" else {"fps": 1 / seconds}
    try:
        imageio.imwrite(path, list(frames), **timing)
    except (OSError, ValueError, ImportError, TypeError) as error:
        raise LareError(
            f"the video {path} cannot be written: {error}; .gif always works, .mp4 needs lare-rl[video]"
        ) from error
