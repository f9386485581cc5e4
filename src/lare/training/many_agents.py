"""A run of many agents under way: the training state, and one update of the policy at a time."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from lare.credit.methods import find_method
from lare.tasks.particles.table import find_particle_task
from lare.training import checkpoint, episodes
from lare.training.environments import Stream
from lare.training.run import Run
from lare.training.seeds import lines, seed_keys
from lare.training.settings import Plan
from lare.training.teams import Compiled, Learner, Played, Recipe, by_team, compiled, init, returns


@dataclass
class Session:
    """The training state. There is nothing on the host but `phi`: between two updates no episode is under way."""

    run: Run
    recipe: Recipe
    functions: Compiled
    learner: Learner
    step: int = 0
    """Environment steps done, of each seed; all agents act in one."""
    metrics_length: int = 0
    """Bytes of metrics.jsonl that belong to the state."""
    latest: dict[str, Float[Array, " seeds"]] = field(default_factory=dict)
    """What the last update measured."""

    @property
    def settings(self) -> Plan:
        return self.run.config.settings

    def keys(self, stream: Stream, number: int) -> Array:
        """A key for each seed, by what it is for and the number of the update."""
        return keys_of(self.run, stream, number)

    def advance(self) -> None:
        """One update: play, factors, replay, sometimes the decoder, the policy."""
        number = self.step // self.settings.turn
        keys = self.keys(Stream.TRAINING_EPISODES, number)
        played = self.functions.play(self.learner.algorithm.online.actor, keys, self.settings.agents.episodes)
        factors = self.factors(played)
        self.learner = self.functions.store(self.learner, played, factors)
        if self.recipe.method.descends and number % self.recipe.agents.fit_every == 0:
            credit, fitted = self.functions.fit(self.learner, self.keys(Stream.FIT, number))
            self.learner = self.learner._replace(credit=credit)
            self.latest |= fitted
        left = 1 - self.step / self.settings.steps
        keys = self.keys(Stream.UPDATE, number)
        self.learner, improved = self.functions.improve(self.learner, played, factors, keys, left)
        self.latest |= improved
        self.step += self.settings.turn

    def factors(self, played: Played) -> Float[np.ndarray, "seeds steps episodes agents factors"]:
        """The factors z of new episodes: each team's `phi` on what each of its agents observed; padded to the largest."""
        found = np.zeros((*played.reward.shape, max(self.recipe.factors, default=0)), np.float32)
        rows = [np.asarray(rows) for rows in (played.observation, played.action, played.next_observation)]
        functions = self.run.functions
        for function, team in zip(functions, self.recipe.task.teams, strict=True) if functions else ():
            before, action, after = (part[..., team.start : team.stop, :] for part in rows)
            factors = self.run.factors(
                function, *(part.reshape(-1, part.shape[-1]) for part in (before, action, after))
            )
            found[..., team.start : team.stop, : factors.shape[1]] = factors.reshape(*action.shape[:-1], -1)
        return found

    def report(self, rate: float) -> list[dict[str, Any]]:
        """Evaluate, always from the same starts; one line of metrics.jsonl for each seed."""
        keys = self.keys(Stream.EVALUATION_EPISODES, 0)
        played = self.functions.play(self.learner.algorithm.online.actor, keys, self.settings.evaluation_episodes)
        task = self.recipe.task
        earned = [{"evaluation/return": jnp.mean(returns(played.reward, team), axis=-1)} for team in task.teams]
        measured = by_team(earned, task)
        measured |= self.functions.assess(self.learner) | self.latest
        return lines(self.run.seeds, self.step, measured, rate)

    def save(self) -> None:
        host = {"step": self.step, "metrics_length": self.metrics_length}
        latest = {f"latest/{name}": np.asarray(values) for name, values in self.latest.items()}
        checkpoint.save(self.run.checkpoint, self.learner, episodes.ROWS, host, latest)

    def close(self) -> None:
        """There is nothing to close."""


def keys_of(run: Run, stream: Stream, number: int) -> Key[Array, " seeds"]:
    """A key for each seed. Evaluations of the run have number 0, updates count from 0."""
    return seed_keys(jnp.asarray(run.seeds), number * len(Stream) + stream + 1)


def recipe_for(run: Run) -> Recipe:
    plan, name = run.config.settings, run.config.task.particles
    assert name is not None
    return Recipe(
        task=find_particle_task(name),
        method=find_method(plan.method),
        ppo=plan.ippo,
        agents=plan.agents.model_copy(update={"capacity": plan.episodes}),
        factors=tuple(function.size_by(run.judges) for function in run.functions),
    )


def new_learners(keys: Array, recipe: Recipe) -> Learner:
    return jax.vmap(partial(init, recipe=recipe))(keys)


def start(run: Run) -> Session:
    """A session before its first step."""
    recipe = recipe_for(run)
    make = jax.jit(partial(new_learners, recipe=recipe))
    return Session(run, recipe, compiled(recipe), make(seed_keys(jnp.asarray(run.seeds), 0)))


def restore(run: Run) -> tuple[Session, list[str]]:
    """A session as of the last checkpoint, and what is to be said about it: nothing, for nothing was lost."""
    recipe, learner, host, arrays = load_learner(run)
    latest = {name.removeprefix("latest/"): jnp.asarray(values) for name, values in arrays.items()}
    return Session(run, recipe, compiled(recipe), learner, host["step"], host["metrics_length"], latest), []


def load_learner(run: Run) -> tuple[Recipe, Learner, dict[str, Any], dict[str, np.ndarray]]:
    """The training state of a run's last checkpoint, and what stood with it."""
    recipe = recipe_for(run)
    shapes = jax.eval_shape(partial(new_learners, recipe=recipe), seed_keys(jnp.asarray(run.seeds), 0))
    return recipe, *checkpoint.load(run.checkpoint, shapes, episodes.ROWS)
