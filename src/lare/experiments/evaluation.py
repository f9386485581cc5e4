"""The policy of a finished (or stopped) run, evaluated and filmed, for one agent and for many."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.experiments import agents
from lare.tasks.particles.drawing import FRAMES_PER_SECOND
from lare.tasks.spec import TaskSpec, check_against_environment
from lare.training.environments import Policy, Stream, episode_seed, evaluate, make_episodic, to_bounds
from lare.training.run import Run, open_run
from lare.training.single_agent import compiled, load_learner


def load_policy(run: Run) -> Policy:
    """The deterministic policies of all seeds, as of the last checkpoint."""
    recipe, learner, _, _ = load_learner(run)
    functions = compiled(recipe)
    actor = functions.actor(learner)
    return lambda observation: np.asarray(functions.act(actor, observation))


def policy_of(directory: str | Path, task: TaskSpec) -> Callable[[np.ndarray], np.ndarray]:
    """The deterministic policy of a run's first seed, from one observation to one action of the environment.

    Raises:
        LareError: the directory is no run, or one of another environment.
    """
    run = open_run(directory)
    if run.config.task.environment != task.environment or task.particles:
        raise LareError(f"{directory} is a run of {run.config.task.name}: its policy cannot play {task.name}")
    policy, space = load_policy(run), make_episodic(task).action_space

    def act(observation: np.ndarray) -> np.ndarray:
        everyone = np.broadcast_to(np.asarray(observation, np.float32), (len(run.seeds), len(observation)))
        return to_bounds(policy(everyone)[0], space)

    return act


def evaluate_run(directory: str | Path, episodes: int = 10) -> dict[str, Float[np.ndarray, "seeds episodes"]]:
    """True returns by team; the only team of most tasks is called by the task's name.

    A single agent acts without noise. Agents of particle tasks draw their actions, as they do in training; a team's
    return is the sum over its agents.

    Raises:
        LareError: the directory is no run, or its task's environment has changed.
    """
    if episodes < 1:
        raise LareError(f"episodes = {episodes}: at least one is needed")
    run = open_run(directory)
    task = run.config.task
    if task.particles:
        return agents.returns(run, episodes)
    check_against_environment(task)
    environments = [[make_episodic(task) for _ in range(episodes)] for _ in run.seeds]
    return {task.name: evaluate(environments, load_policy(run), run.seeds).returns}


def record_video(directory: str | Path, path: str | Path) -> None:
    """Film one episode of the first seed's policy, as a .gif, or as an .mp4 with the extra `lare-rl[video]`.

    Agents of particle tasks wear their credit, as number and colour.

    Raises:
        LareError: the environment cannot be drawn on this machine, or the file cannot be written.
    """
    run, path = open_run(directory), Path(path)
    if run.config.task.particles:
        write_video(path, agents.frames(run), FRAMES_PER_SECOND)
        return
    camera = {"camera_name": "track"} if has_tracking_camera(run) else {}
    environment = make_episodic(run.config.task, render_mode="rgb_array", **camera)
    policy, fps = load_policy(run), environment.metadata.get("render_fps", 30)
    observation, _ = environment.reset(seed=episode_seed(run.seeds[0], Stream.EVALUATION_EPISODES, 0))
    frames, ended = [], False
    try:
        while not ended:
            frames.append(environment.render())
            everyone = np.broadcast_to(np.asarray(observation, np.float32), (len(run.seeds), len(observation)))
            action = to_bounds(policy(everyone)[0], environment.action_space)
            observation, _, terminated, truncated, _ = environment.step(action)
            ended = terminated or truncated
    except Exception as error:  # a missing display shows itself in as many ways as there are graphics libraries
        raise LareError(
            f"{run.config.task.environment} cannot be drawn here: {error}; without a screen, MUJOCO_GL=egl or "
            "MUJOCO_GL=osmesa in the environment may help"
        ) from error
    write_video(path, frames, fps)


def has_tracking_camera(run: Run) -> bool:
    """Whether the environment is a MuJoCo model with a camera that follows it, which Gymnasium does not use by itself."""
    environment = make_episodic(run.config.task)
    model: Any = getattr(environment.unwrapped, "model", None)
    names = [model.camera(number).name for number in range(model.ncam)] if hasattr(model, "ncam") else []
    environment.close()
    return "track" in names


def write_video(path: Path, frames: list, fps: int) -> None:
    import imageio.v3 as imageio

    try:
        if path.suffix == ".gif":
            # Browsers play a GIF at 50 frames a second at most.
            every = max(1, round(fps / 25))
            imageio.imwrite(path, frames[::every], duration=1000 * every // fps, loop=0)
        else:
            imageio.imwrite(path, frames, fps=fps)
    except (OSError, ValueError, ImportError, TypeError) as error:
        raise LareError(
            f"the video {path} cannot be written: {error}; .gif always works, .mp4 needs lare-rl[video]"
        ) from error
