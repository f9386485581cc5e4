"""The training step of PPO: fit the decoder on the replay, relabel the newest steps by it, update the policy on them.

Algorithm 1 of the LaRe paper, lines 6 to 8, for an algorithm that learns from what its newest policy met. The decoder goes
on learning from all that is stored.

Observations reach the networks by their running mean and deviation; those of a rollout are taken in when it has been learned
from, so that the policy that is updated is the policy that acted.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

from lare.algorithms import ppo
from lare.algorithms.ppo import Policy
from lare.normalise import Moments, observe, standardise
from lare.training import learner as common
from lare.training import replay
from lare.training.learner import Compiled, Learner, fit_often, rewards
from lare.training.recipe import Recipe

Actor = tuple[Policy, Moments]
"""A policy, and what its observations are normalised by."""


def actor_of(learner: Learner) -> Actor:
    assert isinstance(learner.algorithm, ppo.PPO)
    assert learner.observations is not None
    return learner.algorithm.online.actor, learner.observations


def seen(observation: Float[Array, "*batch observation"], moments: Moments) -> Float[Array, "*batch observation"]:
    """Observations as the networks get them: as they are, as long as there are no statistics."""
    return jnp.where(moments.seen > 0, standardise(moments, observation), observation)


def newest(held: replay.Replay, recipe: Recipe) -> Int[Array, " time"]:
    """Numbers of the steps of the last rollout."""
    return held.transitions - recipe.turn + jnp.arange(recipe.turn)


def rollout(learner: Learner, recipe: Recipe) -> ppo.Rollout:
    """The newest steps of the replay, a single lane, with what the method pays for them."""
    held, (_, moments) = learner.replay, actor_of(learner)
    number = newest(held, recipe)
    steps = replay.read(held, number)
    # Where a step's successor belongs to another episode, or to none yet, its own has ended.
    episode = held.episode[number % replay.capacity(held)]
    ended = jnp.append(episode[1:] != episode[:-1], ~held.running)
    before, after = (seen(rows, moments) for rows in (steps.observation, steps.next_observation))
    reward = rewards(steps, learner, recipe)
    row = ppo.Rollout(before, steps.action, reward, after, steps.continues, ended.astype(jnp.float32))
    return jax.tree.map(lambda leaf: leaf[:, None], row)


def improve(
    learner: Learner, key: PRNGKeyArray, done: Int[Scalar, ""], recipe: Recipe
) -> tuple[Learner, dict[str, Float[Array, ""]]]:
    """Fit the decoder and update the policy on the steps that have just been stored."""
    assert isinstance(recipe.algorithm, ppo.PPOSettings)
    assert isinstance(learner.algorithm, ppo.PPO)
    fit_key, key = jax.random.split(key)
    algorithm = learner.algorithm
    learner, fitted = fit_often(learner, fit_key, recipe.fit_updates, recipe)
    left = 1 - done / recipe.steps
    algorithm, improved = ppo.update(algorithm, rollout(learner, recipe), key, left, recipe.algorithm)
    _, moments = actor_of(learner)
    taken_in = observe(moments, replay.read(learner.replay, newest(learner.replay, recipe)).observation)
    return learner._replace(algorithm=algorithm, observations=taken_in), fitted | improved


def act(actor: Actor, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch action"]:
    """The likeliest action."""
    policy, moments = actor
    return policy.mode(seen(observation, moments))


def explore(
    actor: Actor, observation: Float[Array, " observation"], noise: Float[Array, " action"]
) -> Float[Array, " action"]:
    """An action of the policy, drawn by given noise."""
    policy, moments = actor
    return policy.drawn(seen(observation, moments), noise)


def noise(random: Sequence[np.random.Generator], recipe: Recipe) -> Float[np.ndarray, "time seeds action"]:
    """For the steps of a rollout: Gumbel's, by which the largest of the disturbed numbers is a choice; or normal."""
    shape = (recipe.turn, recipe.action_size)
    drawn = (one.gumbel(size=shape) if recipe.discrete else one.standard_normal(shape) for one in random)
    return np.stack(list(drawn), 1).astype(np.float32)


def compiled(recipe: Recipe) -> Compiled:
    """The functions of a run."""
    return common.compiled(recipe, improve, actor_of, act, explore, noise)
