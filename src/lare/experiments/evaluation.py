"""The policy of a finished (or stopped) run, evaluated and filmed, for one agent and for many."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.experiments import agents
from lare.tasks.episodic import EpisodicReward
from lare.tasks.particles.drawing import FRAMES_PER_SECOND
from lare.tasks.spec import check_against_environment
from lare.training.environments import Policy, Stream, episode_seed, evaluate, make_episodic, to_bounds
from lare.training.run import Run
from lare.training.single_agent import compiled, load_learner

FRAME = {"width": 320, "height": 320}
"""Pixels of a MuJoCo film: its usual 480 by 480 take twice as long, and as much room."""

AT_A_TIME = 20
"""Environments of a seed that are open together."""


def load_policy(run: Run) -> Policy:
    """The deterministic policies of all seeds, as of the last checkpoint."""
    recipe, learner, _, _ = load_learner(run)
    functions = compiled(recipe)
    actor = functions.actor(learner)
    return lambda observation: np.asarray(functions.act(actor, observation))


def policy_of(run: Run, seed: int | None = None) -> Callable[[np.ndarray], np.ndarray]:
    """The deterministic policy of a seed (the first, unless given), from one observation to one action of the environment.

    Raises:
        LareError: it is a run of many agents, or has no such seed, or no checkpoint.
    """
    if run.config.task.particles:
        raise LareError(f"{run.directory} is a run of {run.config.task.name}: many agents have no single policy")
    if seed is not None and seed not in run.seeds:
        raise LareError(f"{run.directory} has no seed {seed}: there are {', '.join(map(str, run.seeds))}")
    with closing(make_episodic(run.config.task)) as environment:
        return acting(run, environment.action_space, 0 if seed is None else run.seeds.index(seed))


def acting(run: Run, space: gymnasium.Space, place: int = 0) -> Callable[[np.ndarray], np.ndarray]:
    """The deterministic policy of one of the seeds, from one observation to one action within the space."""
    policy = load_policy(run)

    def act(observation: np.ndarray) -> np.ndarray:
        everyone = np.broadcast_to(np.asarray(observation, np.float32), (len(run.seeds), len(observation)))
        return to_bounds(policy(everyone)[place], space)

    return act


def evaluate_run(run: Run, episodes: int = 10) -> dict[str, Float[np.ndarray, "seeds episodes"]]:
    """True returns by team; the only team of most tasks is called by the task's name.

    From starts that no evaluation of the run has used. A single agent acts without noise. Agents of particle tasks draw
    their actions, as they do in training; a team's return is the sum over its agents.

    Raises:
        LareError: there is nothing to evaluate, or the task's environment has changed.
    """
    if episodes < 1:
        raise LareError(f"episodes = {episodes}: at least one is needed")
    task = run.config.task
    if task.particles:
        return agents.returns(run, episodes)
    check_against_environment(task)
    policy, parts = load_policy(run), []
    with ExitStack() as opened:
        environments = [
            [opened.enter_context(closing(make_episodic(task))) for _ in range(min(episodes, AT_A_TIME))]
            for _ in run.seeds
        ]
        used = run.config.settings.evaluation_episodes
        for done in range(0, episodes, AT_A_TIME):
            some = [row[: episodes - done] for row in environments]
            parts.append(evaluate(some, policy, run.seeds, first=used + done).returns)
    return {task.name: np.concatenate(parts, axis=1)}


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
