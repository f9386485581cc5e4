"""A run of a single agent under way: the training state, the environments around it, one chunk of the work at a time."""

import contextlib
import ctypes
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from lare.algorithms.ppo import PPOSettings
from lare.credit.methods import find_method
from lare.tasks.episodic import EpisodicReward
from lare.training import checkpoint, off_policy, on_policy, replay
from lare.training.environments import (
    Collected,
    Explorer,
    Lane,
    Stream,
    collect,
    evaluate,
    generator,
    make_episodic,
)
from lare.training.learner import Compiled, Learner, forget_episode, init
from lare.training.recipe import Recipe
from lare.training.run import Run
from lare.training.seeds import lines, seed_keys
from lare.training.settings import Plan


@dataclass
class Session:
    """The training state, and what is around it on the host."""

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
    def settings(self) -> Plan:
        return self.run.config.settings

    def policy(self, observation: np.ndarray) -> np.ndarray:
        return np.asarray(self.functions.act(self.functions.actor(self.learner), observation))

    def advance(self) -> None:
        """One turn: steps, factors, replay, updates."""
        collected = collect(self.lanes, *self.behaviour())
        steps = collected.steps._replace(factors=self.factors(collected))
        self.learner = self.functions.store(self.learner, steps)
        if self.step >= self.recipe.warmup:
            keys = seed_keys(jnp.asarray(self.run.seeds), self.step + 1)
            self.learner, self.latest = self.functions.improve(self.learner, keys, self.step)
        self.step += self.settings.turn

    def behaviour(self) -> tuple[Explorer, Float[np.ndarray, "time seeds action"]]:
        """How the next steps are collected, and the noise for them."""
        random = [generator(seed, Stream.EXPLORATION, self.step) for seed in self.run.seeds]
        if self.step < self.recipe.warmup:
            shape = (self.settings.turn, self.recipe.action_size)
            return lambda _, noise: noise, np.stack([one.uniform(-1, 1, shape) for one in random], 1).astype(np.float32)
        actor, explore = self.functions.actor(self.learner), self.functions.explore
        return lambda *given: np.asarray(explore(actor, *given)), self.functions.noise(random)

    def factors(self, collected: Collected) -> Float[np.ndarray, "seeds time factors"]:
        """The factors z of new steps: `phi` on the observations that the task says it judges."""
        action = collected.environment_action
        if self.run.function is None:
            return np.zeros((*action.shape[:2], 0), np.float32)
        before, after = np.asarray(collected.steps.observation), np.asarray(collected.steps.next_observation)
        rows = self.run.factors(self.run.function, flat(before), flat(action), flat(after))
        return rows.reshape(*action.shape[:2], -1)

    def report(self, rate: float) -> list[dict[str, Any]]:
        """Evaluate; one line of metrics.jsonl for each seed."""
        config = self.run.config
        evaluation = evaluate(self.evaluation, self.policy, self.run.seeds, config.task.measures)
        measured = {
            "evaluation/return": evaluation.returns.mean(axis=1),
            "evaluation/length": evaluation.lengths.mean(axis=1),
        }
        measured |= {f"evaluation/{name}": values.mean(axis=1) for name, values in evaluation.measures.items()}
        measured |= self.functions.assess(self.learner) | self.latest
        return lines(self.run.seeds, self.step, measured, rate)

    def save(self) -> None:
        host = {
            "step": self.step,
            "metrics_length": self.metrics_length,
            "episodes": [lane.episode for lane in self.lanes],
        }
        arrays = {}
        for place, lane in enumerate(self.lanes):
            arrays[f"lane{place}/actions"] = np.reshape(lane.actions, (-1, self.recipe.action_size))
            arrays[f"lane{place}/observation"] = lane.observation
        checkpoint.save(self.run.checkpoint, self.learner, replay.ROWS, host, arrays)

    def return_to(self, host: dict[str, Any], arrays: dict[str, np.ndarray]) -> list[str]:
        """Put everything around the learner back to a checkpoint; returns what is to be said about it."""
        self.step, self.metrics_length = host["step"], host["metrics_length"]
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
            self.learner = drop(self.learner, jnp.asarray(dropped))
            self.save()  # before a new episode is in the rows of the dropped one, which the checkpoint has as written
        return messages

    def close(self) -> None:
        for environment in itertools.chain((lane.environment for lane in self.lanes), *self.evaluation):
            environment.close()


def flat(rows: np.ndarray) -> np.ndarray:
    """Seeds and time in one axis."""
    return rows.reshape(-1, rows.shape[-1])


@jax.jit
def drop(learner: Learner, dropped: Array) -> Learner:
    """Forget the running episodes of the seeds where `dropped` is true."""

    def choose(shorter: Array, whole: Array) -> Array:
        return jnp.where(dropped.reshape(-1, *[1] * (whole.ndim - 1)), shorter, whole)

    return jax.tree.map(choose, jax.vmap(forget_episode)(learner), learner)


def compiled(recipe: Recipe) -> Compiled:
    """The functions of the run's algorithm."""
    return (on_policy if isinstance(recipe.algorithm, PPOSettings) else off_policy).compiled(recipe)


def recipe_for(run: Run) -> Recipe:
    task, settings = run.config.task, run.config.settings
    return Recipe(
        method=find_method(settings.method),
        algorithm=settings.of_algorithm,
        credit=settings.credit,
        scale_rewards=settings.scale_rewards,
        observation_size=task.observation_size,
        action_size=task.action_size,
        discrete=run.config.discrete,
        factors=run.function.size_by(run.judges) if run.function else 0,
        longest_episode=run.config.longest_episode,
        capacity=settings.rows(run.config.longest_episode),
        steps=settings.steps,
        turn=settings.turn,
        fit_updates=settings.fit_updates,
    )


def load_learner(run: Run) -> tuple[Recipe, Learner, dict[str, Any], dict[str, np.ndarray]]:
    """The training state of a run's last checkpoint, and what stood with it."""
    recipe = recipe_for(run)
    return recipe, *checkpoint.load(run.checkpoint, learner_shape(run), replay.ROWS)


def learner_shape(run: Run) -> Learner:
    """A learner with the shapes of its arrays in their place."""
    return jax.eval_shape(partial(new_learners, recipe=recipe_for(run)), seed_keys(jnp.asarray(run.seeds), 0))


def new_learner(run: Run) -> Learner:
    """An untrained learner."""
    keys = seed_keys(jnp.asarray(run.seeds), 0)
    made = ahead(jax.jit(partial(new_learners, recipe=recipe_for(run))), keys)
    give_memory_back()
    return made(keys)


def new_learners(keys: Key[Array, " seeds"], recipe: Recipe) -> Learner:
    return jax.vmap(partial(init, recipe=recipe))(keys)


def start(run: Run) -> Session:
    """A session before its first step."""
    return begin(run, partial(new_learner, run))


def restore(run: Run) -> tuple[Session, list[str]]:
    """A session as of the last checkpoint, and what is to be said about it."""
    _, learner, host, arrays = load_learner(run)
    session = begin(run, lambda: learner)
    return session, session.return_to(host, arrays)


def begin(run: Run, make_learner: Callable[[], Learner]) -> Session:
    """Environments and compiled functions around a learner, which is made when they are there.

    The compiler needs hundreds of megabytes for a while; what it gives back in time holds the replay.
    """
    recipe, task = recipe_for(run), run.config.task
    functions = compile_ahead(run, recipe)
    give_memory_back()
    learner = make_learner()
    lanes = [Lane(seed, make_episodic(task)) for seed in run.seeds]
    for lane in lanes:
        lane.begin()
    evaluation = [[make_episodic(task) for _ in range(run.config.settings.evaluation_episodes)] for _ in lanes]
    return Session(run, recipe, functions, lanes, evaluation, learner)


def compile_ahead(run: Run, recipe: Recipe) -> Compiled:
    """The functions of a run, compiled for the shapes that they will see."""
    seeds, turn = len(run.seeds), run.config.settings.turn

    def shape(*sizes: int, dtype: type = np.float32) -> Any:
        return jax.ShapeDtypeStruct((seeds, turn, *sizes), dtype)

    observation, flag = shape(recipe.observation_size), shape(dtype=bool)
    steps = replay.Step(observation, shape(recipe.action_size), shape(recipe.factors), shape(), observation, flag, flag)
    functions = compiled(recipe)
    learner, keys = learner_shape(run), jax.eval_shape(seed_keys, jnp.asarray(run.seeds), 0)
    return functions._replace(
        store=ahead(functions.store, learner, steps),
        improve=ahead(functions.improve, learner, keys, 0),
        assess=ahead(functions.assess, learner),
    )


def ahead(function: Any, *shapes: Any) -> Any:
    """A jitted function, compiled before it is called."""
    return function.lower(*shapes).compile()


def give_memory_back() -> None:
    """What the compiler has freed, glibc keeps for the process unless it is asked not to."""
    with contextlib.suppress(OSError, AttributeError):  # there is another C library, or none that can be asked
        ctypes.CDLL(None).malloc_trim(0)
