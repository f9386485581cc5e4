"""What a run of many agents looks like from outside: one episode with everybody's credit, and many for their statistics."""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from lare.algorithms.ppo import Policy
from lare.errors import LareError
from lare.experiments.credit import correlations
from lare.tasks.particles import drawing
from lare.tasks.particles.table import find_particle_task
from lare.tasks.particles.task import Team
from lare.training import teams
from lare.training.environments import Stream
from lare.training.many_agents import Session, keys_of, load_learner, restore
from lare.training.run import Run
from lare.training.seeds import of_seed
from lare.training.teams import Played

SAMPLED = 40
"""Episodes for statistics."""


@dataclass(frozen=True)
class Watched:
    """One episode of the first seed's policy."""

    position: Float[np.ndarray, "steps entities 2"]
    """After each step."""
    reward: Float[np.ndarray, "steps agents"]
    """True."""
    proxy: Float[np.ndarray, "steps agents"] | None
    """By the decoders of the last checkpoint; None for a method without."""

    @property
    def credit(self) -> Float[np.ndarray, "steps agents"]:
        """Proxy rewards, or the true ones of a method without."""
        return self.reward if self.proxy is None else self.proxy


@dataclass(frozen=True)
class Sample:
    """Steps of agents of one team, over some episodes of the first seed's policy."""

    team: Team
    observation: Float[np.ndarray, "rows observation"]
    """What the step led to."""
    factors: Float[np.ndarray, "rows factors"]
    reward: Float[np.ndarray, " rows"]
    """True."""

    @property
    def correlations(self) -> Float[np.ndarray, " factors"]:
        """Pearson's, of each factor with the true reward; NaN where one never varies."""
        return correlations(self.factors, self.reward)


def returns(run: Run, episodes: int) -> dict[str, Float[np.ndarray, "seeds episodes"]]:
    """The sum over its agents of the true rewards, for each team, by its name; from starts that no evaluation has used."""
    recipe, learner, _, _ = load_learner(run)
    keys = keys_of(run, Stream.EVALUATION_EPISODES, 1)
    played = teams.compiled(recipe).play(learner.algorithm.online.actor, keys, episodes)
    return {
        role.name: np.asarray(teams.returns(played.reward, team))
        for role, team in zip(run.config.task.roles, recipe.task.teams, strict=True)
    }


def frames(run: Run) -> list[UInt8[np.ndarray, "height width 3"]]:
    """One episode as pictures, in which everybody wears its credit."""
    watched, name = watch(run), run.config.task.particles
    assert name is not None
    return drawing.frames(find_particle_task(name), watched.position, watched.credit)


def watch(run: Run, key: int = 0) -> Watched:
    """Play one episode."""
    session, _ = restore(run)
    recipe, learner = session.recipe, of_seed(session.learner)
    play = jax.jit(partial(teams.play, count=1, recipe=recipe))
    played = play(learner.algorithm.online.actor, jax.random.key(key))
    proxy = proxy_rewards(session, learner, played)[0] if recipe.method.has_proxy else None
    return Watched(np.asarray(played.position)[:, 0], np.asarray(played.reward)[:, 0], proxy)


def proxy_rewards(
    session: Session, learner: teams.Learner, played: Played
) -> Float[np.ndarray, "episodes steps agents"]:
    """What a single seed's decoders say of episodes."""
    rows = teams.features(played, jnp.asarray(factors_of(session, played)), session.recipe)
    reward = jnp.swapaxes(played.reward, 0, 1)
    return np.asarray(jax.jit(partial(teams.rewards, recipe=session.recipe))(learner, rows, reward))


def factors_of(session: Session, played: Played) -> Float[np.ndarray, "steps episodes agents factors"]:
    """The factors z of episodes of a single seed."""
    return session.factors(jax.tree.map(lambda leaf: leaf[None], played))[0]


def indifferent(policy: Policy) -> Policy:
    """Of a policy's form, but with random actions: a network of zeros prefers nothing."""
    return jax.tree.map(jnp.zeros_like, policy)


def sample(run: Run, random: bool = False) -> list[Sample]:
    """Steps of each team, under the first seed's policy, or under random actions."""
    session, _ = restore(run)
    recipe, policy = session.recipe, of_seed(session.learner).algorithm.online.actor
    if random:
        policy = indifferent(policy)
    played = jax.jit(partial(teams.play, count=SAMPLED, recipe=recipe))(policy, jax.random.key(1))
    factors, found = factors_of(session, played), []
    for place, team in enumerate(recipe.task.teams):
        agents = slice(team.start, team.stop)
        size = recipe.factors[place] if recipe.factors else 0
        rows = (np.asarray(played.next_observation)[..., agents, :], factors[..., agents, :size])
        reward = np.asarray(played.reward)[..., agents].ravel()
        observation, of_team = (part.reshape(len(reward), -1) for part in rows)
        found.append(Sample(team, observation, of_team, reward))
    return found


class Mixed(eqx.Module):
    """A policy whose first team is led by one policy and whose other agents are led by another."""

    first: Policy
    others: Policy
    stop: int = eqx.field(static=True)
    """Where the first team ends."""

    def sample(self, observation: Float[Array, "*batch agents observation"], key: PRNGKeyArray) -> Array:
        """Each draws its own actions."""
        keys = jax.random.split(key)
        ours, theirs = self.first.sample(observation, keys[0]), self.others.sample(observation, keys[1])
        return jnp.concatenate([ours[..., : self.stop, :], theirs[..., self.stop :, :]], axis=-2)


class Match(NamedTuple):
    """How the first team of one run did against the others of another: its return, for each pair of seeds."""

    first: Run
    others: Run
    returns: Float[np.ndarray, "seeds other_seeds"]


def cross_play(runs: tuple[Run, Run], episodes: int = 200) -> list[Match]:
    """Let the first team of each run meet the other team of each: four matches, all from the same starts.

    Raises:
        LareError: the runs are not of one task with two teams, or there is to be no episode.
    """
    if episodes < 1:
        raise LareError(f"episodes = {episodes}: at least one is needed")
    names = {run.config.task.name for run in runs}
    if len(names) > 1 or len(runs[0].config.task.teams) != 2:
        raise LareError(
            f"cross-play needs two runs of one task in which two teams learn, and these are of {', '.join(sorted(names))}"
        )
    loaded = [load_learner(run) for run in runs]
    recipe = loaded[0][0]
    stop = recipe.task.teams[0].stop

    @jax.jit
    def total(mixed: Mixed, key: PRNGKeyArray) -> Float[Array, ""]:
        return jnp.mean(teams.returns(teams.play(mixed, key, episodes, recipe).reward, recipe.task.teams[0]))

    def policies(place: int) -> list[Policy]:
        actors = loaded[place][1].algorithm.online.actor
        return [of_seed(actors, seed) for seed in range(len(runs[place].seeds))]

    matches = []
    for ours, first in enumerate(runs):
        for theirs, others in enumerate(runs):
            returns = [
                [float(total(Mixed(one, other, stop), jax.random.key(0))) for other in policies(theirs)]
                for one in policies(ours)
            ]
            matches.append(Match(first, others, np.array(returns)))
    return matches
