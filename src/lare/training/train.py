"""Training from start to end, and from a checkpoint to the end: Algorithm 1 of the LaRe paper around the fused step."""

import contextlib
import math
import signal
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lare.credit.methods import Encoder, find_method
from lare.errors import LareError
from lare.latent.design import design
from lare.latent.function import LatentFunction
from lare.tasks.episodic import EpisodicReward
from lare.tasks.spec import TaskSpec, load_task
from lare.training import checkpoint, replay
from lare.training.environments import (
    Collected,
    Lane,
    Stream,
    collect,
    evaluate,
    generator,
    make_episodic,
)
from lare.training.off_policy import Compiled, Learner, Recipe, compiled
from lare.training.progress import Clock, Listener, TensorBoard, Terminal
from lare.training.replay import Step
from lare.training.run import Run, create, default_directory, locked, open_run
from lare.training.settings import Settings


class Interrupted(LareError):
    """The user stopped a run. It was saved."""


def train(
    task: str | Path | TaskSpec,
    settings: Settings | None = None,
    *,
    function: LatentFunction | None = None,
    out: str | Path | None = None,
    tensorboard: bool = False,
    listeners: Sequence[Listener] | None = None,
) -> Run:
    """Train on a task's episodic rewards.

    Args:
        task: a shipped name, the path of a TOML file, or a spec.
        settings: method, algorithm, steps, seeds and all the rest.
        function: `phi`, for the methods that need one; without it, it is designed from the shipped recordings.
        out: the run directory, which must not exist; `runs/...` unless given.
        listeners: who is told of the progress; the terminal, unless given.

    Raises:
        LareError: something that was given cannot be used, or an environment or function failed. What was written until
            then is whole, and `resume` goes on from there.
    """
    task = task if isinstance(task, TaskSpec) else load_task(task)
    settings = settings or Settings()
    if find_method(settings.method).encoder is not Encoder.LATENT:
        function = None
    elif function is None:
        function = design(task, draw=settings.draw)
    run = create(Path(out) if out is not None else default_directory(task, settings), task, settings, function)
    with locked(run):
        session = begin(run)
        session.save()
        return finish(session, tensorboard, listeners)


def resume(
    directory: str | Path, *, tensorboard: bool = False, listeners: Sequence[Listener] | None = None
) -> Run:
    """Go on with a run that was stopped or killed, from its last checkpoint to its end.

    On the CPU the metrics are then, bit for bit, those of a run that never stopped (but for the times).
    """
    run = open_run(directory)
    with locked(run):
        session = begin(run)
        return finish(session, tensorboard, listeners, *session.restore())


@dataclass
class Session:
    """A run under way: the training state, and what is around it on the host."""

    run: Run
    recipe: Recipe
    functions: Compiled
    lanes: list[Lane]
    evaluation: list[list[EpisodicReward]]
    learner: Learner
    step: int = 0
    """Environment steps done, of each seed."""
    metrics_length: int = 0
    """Bytes of metrics.jsonl that belong to the state."""
    latest: dict[str, Float[Array, " seeds"]] = field(default_factory=dict)
    """What the last chunk of updates measured."""

    @property
    def settings(self) -> Settings:
        return self.run.config.settings

    def policy(self, observation: np.ndarray) -> np.ndarray:
        return np.asarray(self.functions.act(self.learner.algorithm.online.actor, observation))

    def advance(self) -> None:
        """One chunk: steps, factors, replay, updates."""
        collected = collect(self.lanes, *self.behaviour())
        steps = collected.steps._replace(factors=self.factors(collected))
        self.learner = self.functions.store(self.learner, steps)
        warmup = self.settings.td3.warmup
        if self.step >= warmup:
            keys = seed_keys(jnp.asarray(self.settings.all_seeds), self.step + 1)
            self.learner, self.latest = self.functions.improve(self.learner, keys, self.step - warmup)
        self.step += self.settings.chunk

    def behaviour(self) -> tuple[Any, Float[np.ndarray, "time seeds action"]]:
        """The policy that collects the next chunk, and the noise on its actions."""
        shape, td3 = (self.settings.chunk, self.recipe.action_size), self.settings.td3
        random = [generator(seed, Stream.EXPLORATION, self.step) for seed in self.settings.all_seeds]
        if self.step < td3.warmup:
            idle = np.zeros((len(self.lanes), self.recipe.action_size), np.float32)
            return lambda _: idle, np.stack([one.uniform(-1, 1, shape) for one in random], 1).astype(np.float32)
        noise = np.stack([one.standard_normal(shape) for one in random], 1)
        return self.policy, (td3.exploration_noise * noise).astype(np.float32)

    def factors(self, collected: Collected) -> Float[np.ndarray, "seeds time factors"]:
        """z of new steps: `phi` on the observations that the task says it judges."""
        if self.run.function is None:
            return collected.steps.factors
        steps, action = collected.steps, collected.environment_action
        before, after = steps.observation, steps.next_observation
        judged = {"before": [before], "after": [after], "both": [before, after]}[self.judges]
        rows = [self.run.function(flat(observation), flat(action)) for observation in judged]
        return np.concatenate(rows, axis=1).reshape(*action.shape[:2], -1)

    @property
    def judges(self) -> str:
        return self.settings.judges or self.run.config.task.judges

    def report(self, rate: float) -> list[dict[str, Any]]:
        """Evaluate; one line of metrics.jsonl for each seed."""
        config = self.run.config
        evaluation = evaluate(self.evaluation, self.policy, self.settings.all_seeds, config.task.measures)
        measured = {"evaluation/return": evaluation.returns.mean(axis=1)}
        measured |= {f"evaluation/{name}": values.mean(axis=1) for name, values in evaluation.measures.items()}
        measured |= {name: np.asarray(value) for name, value in self.functions.assess(self.learner).items()}
        measured |= {name: np.asarray(value) for name, value in self.latest.items()}
        lines = []
        for place, seed in enumerate(self.settings.all_seeds):
            numbers = {name: float(values[place]) for name, values in measured.items()}
            # JSON knows no NaN: a correlation with something that never varies is null.
            known = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
            lines.append({"step": self.step, "seed": seed, **known, "time/steps_per_second": round(rate, 1)})
        return lines

    def check_diverged(self, lines: Sequence[dict[str, Any]]) -> None:
        for line in lines:
            for name in ("critic/loss", "credit/loss"):
                if name in line and line[name] is None:
                    raise LareError(
                        f"training diverged: {name} of seed {line['seed']} is not finite at step {self.step}; "
                        f"the last checkpoint in {self.run.checkpoint} is whole"
                    )

    def save(self) -> None:
        host = {"step": self.step, "metrics_length": self.metrics_length, "episodes": [lane.episode for lane in self.lanes]}
        arrays = {}
        for place, lane in enumerate(self.lanes):
            arrays[f"lane{place}/actions"] = np.reshape(lane.actions, (-1, self.recipe.action_size))
            arrays[f"lane{place}/observation"] = lane.observation
        checkpoint.save(self.run.checkpoint, self.learner, host, arrays)

    def restore(self) -> list[str]:
        """Go back to the last checkpoint; returns what is to be said about it."""
        self.learner, host, arrays = checkpoint.load(self.run.checkpoint, self.learner)
        self.step, self.metrics_length = host["step"], host["metrics_length"]
        self.run.truncate(self.metrics_length)
        messages, dropped = [], []
        for place, (lane, episode) in enumerate(zip(self.lanes, host["episodes"], strict=True)):
            lane.episode = episode
            actions, observation = arrays[f"lane{place}/actions"], arrays[f"lane{place}/observation"]
            restored = lane.replay(list(actions), observation)
            dropped.append(not restored)
            if not restored:
                lane.begin()
                messages.append(
                    f"episode {episode} of seed {lane.seed} was dropped after {len(actions)} steps: the environment did "
                    "not come back to the same observation by the same actions"
                )
        if any(dropped):
            self.learner = self.learner._replace(replay=drop(self.learner.replay, jnp.asarray(dropped)))
        return messages


def flat(rows: np.ndarray) -> np.ndarray:
    """Seeds and time in one axis."""
    return rows.reshape(-1, rows.shape[-1])


@jax.jit
def drop(held: replay.Replay, dropped: Array) -> replay.Replay:
    """Forget the running episodes of the seeds where `dropped` is true."""

    def choose(shorter: Array, whole: Array) -> Array:
        return jnp.where(dropped.reshape(-1, *[1] * (whole.ndim - 1)), shorter, whole)

    return jax.tree.map(choose, jax.vmap(replay.drop_running)(held), held)


@jax.jit
def seed_keys(seeds: Array, number: int) -> PRNGKeyArray:
    """A key for each seed that depends on the seed and `number` alone: there is no state to save."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed), number))(seeds)


def recipe_for(run: Run, environment: EpisodicReward) -> Recipe:
    """Raises `LareError` where the replay could not hold a single episode."""
    task, settings = run.config.task, run.config.settings
    assert environment.spec is not None
    longest = environment.spec.max_episode_steps
    assert longest is not None
    if settings.rows < longest + 2:
        raise LareError(f"capacity = {settings.rows} is too small: an episode of {task.name} takes up to {longest + 1}")
    factors = run.function.size if run.function else 0
    return Recipe(
        method=find_method(settings.method),
        td3=settings.td3,
        credit=settings.credit,
        scale_rewards=settings.scale_rewards,
        observation_size=task.observation_size,
        action_size=task.action_size,
        factors=2 * factors if (settings.judges or task.judges) == "both" else factors,
        longest_episode=longest,
        capacity=settings.rows,
    )


def begin(run: Run) -> Session:
    """Environments, compiled functions and an untrained learner."""
    settings, task = run.config.settings, run.config.task
    lanes = [Lane(seed, make_episodic(task)) for seed in settings.all_seeds]
    recipe = recipe_for(run, lanes[0].environment)
    functions = compiled(recipe, settings.chunk)
    learner = functions.init(seed_keys(jnp.asarray(settings.all_seeds), 0))
    for lane in lanes:
        lane.begin()
    evaluation = [[make_episodic(task) for _ in range(settings.evaluation_episodes)] for _ in lanes]
    return Session(run, recipe, functions, lanes, evaluation, learner)


def finish(
    session: Session, tensorboard: bool, listeners: Sequence[Listener] | None, *messages: str
) -> Run:
    """Run a session to its end, or until the user stops it."""
    run, settings = session.run, session.settings
    told: list[Listener] = [Terminal()] if listeners is None else list(listeners)
    if tensorboard:
        told.append(TensorBoard(run.directory / "tensorboard", session.step, settings.all_seeds))
    for listener in told:
        for message in messages:
            listener.said(message)
        listener.started(f"{run.config.task.name} {settings.method}", session.step, settings.steps)
    clock = Clock(session.step)
    try:
        with stop_requests() as stop:
            while session.step < settings.steps:
                session.advance()
                for listener in told:
                    listener.stepped(session.step)
                if session.step % settings.evaluate_every == 0 or session.step == settings.steps:
                    lines = session.report(clock.rate(session.step))
                    session.check_diverged(lines)
                    session.metrics_length = run.append(lines)
                    session.save()
                    for listener in told:
                        listener.evaluated(lines)
                if stop.is_set() and session.step < settings.steps:
                    session.save()
                    raise Interrupted(
                        f"stopped at step {session.step} and saved; go on with: lare train --resume {run.directory}"
                    )
    finally:
        for listener in told:
            listener.stopped()
        for environment in [lane.environment for lane in session.lanes] + sum(session.evaluation, []):
            environment.close()
    return run


@contextlib.contextmanager
def stop_requests() -> Iterator[threading.Event]:
    """An event that Ctrl-C or a polite kill sets, once; a second one ends the process at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread may say what a signal does
        return

    def handle(number: int, frame: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
