"""Films of an episode of a run's policy, for one agent and for many."""

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from importlib.util import find_spec
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.envs.families import make_local_env
from lare_rl.envs.gymnasium_env import GymnasiumEnv
from lare_rl.envs.interface import Frame, HostEnv
from lare_rl.envs.jax_on_host import JaxOnHost
from lare_rl.envs.placement import load_env_spec, make_host_env
from lare_rl.envs.play import play_steps
from lare_rl.errors import LareError, missing_extra_error
from lare_rl.evaluation.played_episodes import play_run
from lare_rl.evaluation.policy import RunPolicy
from lare_rl.runs.directory import Run
from lare_rl.training.collect_device import make_jax_env
from lare_rl.training.streams import Stream, episode_seed
from lare_rl.util.files import check_new_path, write_bytes

__all__ = ["check_video_path", "encode_film", "record_frames", "record_video", "write_video"]

MANY_AGENTS_FPS = 8
"""Frames per second, if a film shows many agents."""
MAX_GIF_FPS = 25.0
"""The most frames per second of a GIF and of a film in JAX: drawing a frame may take long without a graphics card."""
DEFAULT_FPS = 30
"""Frames per second of an environment that does not say how many it draws."""
MAX_DRAWINGS = 200
"""The most frames of a film of a single agent in JAX, whose package may need a second for each."""
FRAME_SIZE = {"width": 320, "height": 320}
"""Pixels of the film of a MuJoCo model with a camera that follows it. The default, 480 by 480, takes twice the time and space."""
FILM_SIZE, FILM_QUALITY = 240, 55
"""The largest width and height of a film in a page, in pixels, and its quality."""


def record_video(run: Run, path: str | Path, best: bool = False, deterministic: bool = False) -> None:
    """Film one episode of the first seed's policy: the last policy or, with `best`, the best one.

    The film is a .gif or, with the extra `lare-rl[video]`, an .mp4.

    A film of a particle task shows each agent's credit, as number and colour.

    Raises `LareError` if the run has no checkpoint, the environment cannot be drawn on this machine, or the file cannot be written.
    """
    path = Path(path)
    check_video_path(path)
    max_fps = MAX_GIF_FPS if path.suffix == ".gif" else math.inf
    write_video(path, *record_frames(run, best, deterministic, max_fps=max_fps))


def record_frames(
    run: Run,
    best: bool = False,
    deterministic: bool = False,
    *,
    max_fps: float = MAX_GIF_FPS,
    max_frames: int | None = None,
) -> tuple[list[Frame], float]:
    """Return the frames that `record_video` shows, and the seconds for which it shows each.

    Args:
        max_fps: the largest number of frames per second, for a simulation on the host. An environment in JAX is shown at 25 frames
            per second, and a team at 8.
        max_frames: the largest number of frames. A longer film ends early; that of a single agent in JAX leaves steps out, and so
            shows the episode faster.

    Raises:
        LareError: the environment cannot be drawn on this machine.
    """
    spec = load_env_spec(run.config.task)
    if spec.n_agents > 1:
        if best or deterministic:
            raise LareError(
                "many agents are filmed as they act in training, with their credit: leave best and deterministic out"
            )
        if not spec.is_jax:
            raise LareError(
                f"{run.config.task.name} steps on the host, where only single agents are filmed: leave the video out"
            )
        played = play_run(run)
        frames = make_jax_env(run.config.task).frames(*played.select_episode((played.state, played.credit)))
        return frames[:max_frames], 1 / MANY_AGENTS_FPS
    policy = RunPolicy(run, best=best, deterministic=deterministic)
    if spec.is_jax:
        return _play_and_draw(run, policy, min(max_frames or MAX_DRAWINGS, MAX_DRAWINGS)), 1 / MAX_GIF_FPS
    return _record_on_host(run, policy, max_fps, max_frames)


def encode_film(frames: Sequence[Frame], frame_seconds: float, max_bytes: int) -> bytes:
    """Return a small film as an animated WebP. It ends early if it would be larger than `max_bytes`, and has one frame or more."""
    images = _to_images(frames)
    for image in images:
        image.thumbnail((FILM_SIZE, FILM_SIZE))
    while True:
        film = _encode(images, "WEBP", frame_seconds, quality=FILM_QUALITY, method=4)
        if len(film) <= max_bytes or len(images) == 1:
            return film
        images = images[: max(1, int(0.95 * len(images) * max_bytes / len(film)))]


def check_video_path(path: Path) -> None:
    """Raise `LareError` if a video could not be written. Call this before the work is done."""
    if path.suffix not in (".gif", ".mp4"):
        raise LareError(f"{path} is no name of a video: it ends in .gif, or in .mp4 with the extra lare-rl[video]")
    package, extra = ("imageio", "video") if path.suffix == ".mp4" else ("PIL", "report")
    if find_spec(package) is None:
        raise missing_extra_error(f"a film in {path.suffix}", extra)
    check_new_path(path, overwrite=True)


def write_video(path: Path, frames: Sequence[Frame], frame_seconds: float) -> None:
    """Write a film whose frames are shown for `frame_seconds` each. Raise `LareError` if that fails."""
    if path.suffix == ".gif":
        write_bytes(path, _encode(_to_images(frames), "GIF", frame_seconds))
        return
    try:
        import imageio.v3 as imageio

        imageio.imwrite(path, list(frames), fps=1 / frame_seconds)
    except (OSError, ValueError, ImportError, TypeError) as error:
        hint = "; .mp4 needs lare-rl[video]" if isinstance(error, ImportError) else ""
        raise LareError(f"the video {path} cannot be written: {error}{hint}") from error


def _to_images(frames: Iterable[Frame]) -> list[Any]:
    try:
        from PIL import Image
    except ImportError as missing:
        raise missing_extra_error("a film", "report") from missing
    return [Image.fromarray(frame) for frame in frames]


def _encode(images: Sequence[Any], file_format: str, frame_seconds: float, **options: Any) -> bytes:
    """Return an animation that repeats. A frame of a GIF lasts whole hundredths of a second."""
    buffer, unit_ms = BytesIO(), 10 if file_format == "GIF" else 1
    duration_ms = unit_ms * round(1000 * frame_seconds / unit_ms)
    first, *rest = images
    first.save(buffer, file_format, save_all=True, append_images=rest, duration=duration_ms, loop=0, **options)
    return buffer.getvalue()


def _record_on_host(run: Run, policy: RunPolicy, max_fps: float, max_frames: int | None) -> tuple[list[Frame], float]:
    camera = {"camera_name": "track", **FRAME_SIZE} if _has_tracking_camera(run) else {}
    task = run.config.task.evaluation_task
    with closing(make_host_env(task, render_mode="rgb_array", **camera)) as env:
        metadata = env.environment.metadata if isinstance(env, GymnasiumEnv) else {}
        fps = metadata.get("render_fps") or DEFAULT_FPS
        interval = max(1, math.ceil(fps / max_fps))
        return _play_and_capture(run, env, policy, lambda: _render(env, run), interval, max_frames), interval / fps


def _play_and_draw(run: Run, policy: RunPolicy, max_frames: int) -> list[Frame]:
    """Play an episode of an environment in JAX. Draw the states in which the policy acts, or some of them if there are many."""
    env = make_local_env(run.config.task)
    assert isinstance(env, JaxOnHost)
    states = _play_and_capture(run, env, policy, lambda: env.state)
    states = states[:: math.ceil(len(states) / max_frames)]
    return env.env.frames(jax.device_get(jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)))


def _play_and_capture(
    run: Run,
    env: HostEnv,
    policy: RunPolicy,
    capture: Callable[[], Any],
    interval: int = 1,
    max_captures: int | None = None,
) -> list[Any]:
    """Play an episode. Return what `capture` returns before every `interval`-th action, at most `max_captures`."""
    captures, steps = [], count()

    def act(*inputs: np.ndarray) -> np.ndarray:
        if next(steps) % interval == 0:
            captures.append(capture())
        return policy.select_env_action(*inputs)

    seed = episode_seed(run.seeds[0], Stream.EVALUATION_EPISODES, 0)
    for _ in play_steps(env, act, np.random.default_rng(0), seed):
        if len(captures) == max_captures:
            break
    return captures


def _render(env: HostEnv, run: Run) -> Frame:
    try:
        with warnings.catch_warnings():
            # Graphics libraries warn if they find no screen, although another library may need none.
            warnings.simplefilter("ignore")
            pixels = np.asarray(env.render())
        if pixels.ndim != 3 or pixels.dtype != np.uint8 or pixels.shape[2] not in (3, 4):
            raise ValueError(f"render returns {pixels.dtype} {pixels.shape}, no picture (height, width, 3) of uint8")
        return pixels
    except Exception as error:  # every graphics library has a different error for a missing display
        raise LareError(
            f"{run.config.task.environment} cannot be drawn here: {error}; without a screen, set MUJOCO_GL=egl"
        ) from error


def _has_tracking_camera(run: Run) -> bool:
    """Return whether the environment is a MuJoCo model with a camera that follows it, which Gymnasium must be asked for by name."""
    with closing(make_host_env(run.config.task.evaluation_task)) as env:
        if not isinstance(env, GymnasiumEnv):
            return False
        model: Any = getattr(env.environment.unwrapped, "model", None)
        return hasattr(model, "ncam") and "track" in (model.camera(index).name for index in range(model.ncam))
