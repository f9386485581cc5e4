"""The training state of a single agent's run: what is stored, what the decoder is fitted to, what the algorithm is paid.

For a single agent this is the one place where credit and algorithm meet (for many it is `teams.py`): `credit` does not know
what its rewards are for, the algorithm not where they come from. What differs between algorithms, when to update and how
to act, is in `off_policy.py` and `on_policy.py`.

Functions are written for one seed; sessions give them their leading seed axis.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lare.algorithms import ppo, sac, td3
from lare.credit import accuracy, decomposition
from lare.credit.accuracy import RECENT
from lare.credit.decomposition import Decomposition, Episodes
from lare.credit.methods import Encoder, Method, Reward
from lare.normalise import Moments, Scale, magnitude, no_moments, no_scale, observe_scale, within_range
from lare.training import replay
from lare.training.credit_draws import CreditDraws, draw_credit
from lare.training.recipe import Recipe
from lare.training.replay import Draw, Replay, Step


class Learner(NamedTuple):
    """The whole training state of one seed."""

    algorithm: td3.TD3 | sac.SAC | ppo.PPO
    credit: Decomposition | None
    scale: Scale
    observations: Moments | None
    """What an on-policy algorithm's observations are normalised by."""
    replay: Replay


def init(key: PRNGKeyArray, recipe: Recipe) -> Learner:
    algorithm_key, credit_key = jax.random.split(key)
    sizes = recipe.observation_size, recipe.action_size
    observations = None
    match recipe.algorithm:
        case ppo.PPOSettings():
            algorithm = ppo.init(algorithm_key, *sizes, recipe.discrete, recipe.algorithm)
            observations = no_moments(recipe.observation_size)
        case sac.SACSettings():
            algorithm = sac.init(algorithm_key, *sizes, recipe.algorithm)
        case td3.TD3Settings():
            algorithm = td3.init(algorithm_key, *sizes, recipe.algorithm)
    return Learner(
        algorithm,
        None
        if recipe.method.reward is not Reward.PROXY
        else decomposition.init(
            credit_key, recipe.features, recipe.method, recipe.credit, steps=recipe.longest_episode, agents=1
        ),
        no_scale(),
        observations,
        replay.empty(recipe.capacity, recipe.observation_size, recipe.action_size, recipe.factors),
    )


def features(steps: Step | Draw, method: Method) -> Float[Array, "batch features"]:
    """What the method's decoder sees of some steps."""
    if method.latent:
        return jnp.asarray(steps.factors)
    # A Gaussian may choose beyond the bounds; what happened is that the bound was taken.
    rows = [steps.observation, jnp.clip(steps.action, -1, 1)]
    if method.encoder is Encoder.RAW:
        rows.append(steps.observation - steps.next_observation)
    return jnp.concatenate(rows, axis=-1)


def store(learner: Learner, steps: Step, recipe: Recipe) -> Learner:
    """Put new steps into the replay and into the running statistics."""
    before = learner.replay.episodes
    held = replay.extend(learner.replay, steps)
    episode = before + jnp.arange(len(steps.reward))
    finished = episode < held.episodes
    first = held.first[episode % len(held.first)]
    length = jnp.where(finished, replay.end_of(held, episode) - first, 1)
    mean_reward = held.episode_return[episode % len(held.first)] / length
    credit = learner.credit
    if credit is not None:
        seen = features(steps, recipe.method)
        credit = decomposition.observe_steps(credit, seen)
        credit = decomposition.observe_returns(credit, mean_reward, finished)
        if recipe.method.fit is not None and recipe.method.fit.closed_form:
            ended = jnp.asarray(steps.ended)
            at_its_end = mean_reward[jnp.cumsum(ended) - 1]
            way, settings = recipe.method.fit, recipe.credit
            credit = decomposition.fit_in_closed_form(credit, seen, at_its_end, ended, way, settings)
    return learner._replace(credit=credit, scale=observe_scale(learner.scale, mean_reward, finished), replay=held)


def forget_episode(learner: Learner) -> Learner:
    """Without the episode that is under way."""
    credit = None if learner.credit is None else decomposition.forget_episode(learner.credit)
    return learner._replace(credit=credit, replay=replay.drop_running(learner.replay))


def fit(
    credit: Decomposition, held: Replay, draws: CreditDraws, key: PRNGKeyArray, recipe: Recipe
) -> tuple[Decomposition, dict[str, Float[Array, ""]]]:
    """One update of the decoder."""
    assert recipe.method.fit is not None
    seen, chosen = features(replay.read(held, draws.steps), recipe.method), draws.episodes
    episodes = Episodes(seen, draws.episode, chosen.length, chosen.mean_reward, chosen.counts)
    return decomposition.update(credit, episodes, key, recipe.method.fit, recipe.credit)


def fit_often(
    learner: Learner, key: PRNGKeyArray, updates: int, recipe: Recipe
) -> tuple[Learner, dict[str, Float[Array, ""]]]:
    """Some updates of the decoder, one behind the other; the mean of each metric over them."""
    draw_key, key = jax.random.split(key)
    draws = draw_credit(learner.replay, draw_key, updates, recipe)
    if learner.credit is None or draws is None:
        return learner, {}

    def one(credit: Decomposition, turn: tuple[CreditDraws, PRNGKeyArray]):
        return fit(credit, learner.replay, *turn, recipe)

    credit, measured = jax.lax.scan(one, learner.credit, (draws, jax.random.split(key, updates)))
    return learner._replace(credit=credit), jax.tree.map(jnp.mean, measured)


def rewards(batch: Draw, learner: Learner, recipe: Recipe) -> Float[Array, " batch"]:
    """What the algorithm is trained on."""
    match recipe.method.reward:
        case Reward.TRUE:
            reward = batch.reward
        case Reward.EPISODIC:
            reward = batch.episodic_reward
        case _:
            reward = proxy_rewards(batch, learner, recipe)
    return reward / magnitude(learner.scale) if recipe.scale_rewards else reward


def proxy_rewards(batch: Draw, learner: Learner, recipe: Recipe) -> Float[Array, " batch"]:
    """r_hat of a method that has one, always by the decoder as it stands."""
    if recipe.method.reward is Reward.DESIGNED:
        return batch.factors[:, 0]
    if recipe.method.reward is Reward.UNIFORM:
        # What an episode under way is worth is not known yet.
        return jnp.where(batch.finished, within_range(learner.scale, batch.mean_reward), 0.5)
    assert learner.credit is not None
    return decomposition.proxy_rewards(learner.credit, features(batch, recipe.method), recipe.credit)


def assess(learner: Learner, steps: int, recipe: Recipe) -> dict[str, Float[Array, ""]]:
    """How near the newest proxy rewards come to the true ones, over the last `steps` steps."""
    if not recipe.method.has_proxy:
        return {}
    held = learner.replay
    number = held.transitions - 1 - jnp.arange(steps)
    counts = number >= replay.oldest_transition(held)
    recent = replay.read(held, jnp.where(counts, number, replay.oldest_transition(held)))
    r_hat = proxy_rewards(recent, learner, recipe)
    return accuracy.metrics(r_hat, recent.reward, counts, recipe.method.in_units)


class Compiled(NamedTuple):
    """How an algorithm is trained. Every array has a leading seed axis, but for `done`."""

    store: Callable[[Learner, Step], Learner]
    improve: Callable[..., tuple[Learner, dict[str, Float[Array, " seeds"]]]]
    """From learner, keys, and the environment steps done before; the mean of each metric over its updates."""
    assess: Callable[[Learner], dict[str, Float[Array, " seeds"]]]
    actor: Callable[[Learner], Any]
    """What is needed to act."""
    act: Callable[[Any, np.ndarray], Float[Array, "seeds *episodes action"]]
    """The deterministic policy, from actor and observations."""
    explore: Callable[[Any, np.ndarray, np.ndarray], Float[Array, "seeds action"]]
    """The policy that collects, from actor, observations and noise."""
    noise: Callable[[Sequence[np.random.Generator]], Float[np.ndarray, "time seeds action"]]
    """For the steps of a turn, from a generator for each seed."""


def compiled(
    recipe: Recipe,
    improve: Callable[..., Any],
    actor: Callable[[Learner], Any],
    act: Callable[..., Array],
    explore: Callable[..., Array],
    noise: Callable[..., np.ndarray],
) -> Compiled:
    """`store` and `improve` consume the learner that they are given: its memory holds the new one."""
    return Compiled(
        store=jax.jit(jax.vmap(partial(store, recipe=recipe)), donate_argnums=0),
        improve=jax.jit(jax.vmap(partial(improve, recipe=recipe), in_axes=(0, 0, None)), donate_argnums=0),
        assess=jax.jit(jax.vmap(partial(assess, steps=RECENT, recipe=recipe))),
        actor=actor,
        act=jax.jit(jax.vmap(act)),
        explore=jax.jit(jax.vmap(explore)),
        noise=partial(noise, recipe=recipe),
    )
