"""The fused training step: draw, fit the decoder, relabel by it, update the algorithm; many times in one compiled call.

Algorithm 1 of the LaRe paper, lines 6 to 8, for off-policy algorithms. This is the one place where credit and algorithm
meet: `credit` does not know what its rewards are for, the algorithm not where they come from.

Functions are written for one seed; `compiled` gives them their leading seed axis.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

from lare.algorithms import td3
from lare.credit import accuracy, decomposition
from lare.credit.decomposition import CreditSettings, Decomposition, Episodes
from lare.credit.methods import Encoder, Fit, Method, Reward
from lare.normalise import Scale, magnitude, no_scale, observe_scale
from lare.training import replay
from lare.training.replay import Draw, Replay, Step

RECENT = 5000
"""Steps over which proxy rewards are compared with the true ones."""


@dataclass(frozen=True)
class Recipe:
    """What is to be trained and how: everything that the compiled functions hold fixed."""

    method: Method
    td3: td3.TD3Settings
    credit: CreditSettings
    scale_rewards: bool
    """Divide the rewards that the algorithm sees by the running root mean square of R/T."""
    observation_size: int
    action_size: int
    factors: int
    longest_episode: int
    capacity: int

    @property
    def features(self) -> int:
        """Size of what the decoder sees."""
        return self.factors if self.method.encoder is Encoder.LATENT else 2 * self.observation_size + self.action_size


class Learner(NamedTuple):
    """The whole training state of one seed."""

    algorithm: td3.TD3
    credit: Decomposition | None
    scale: Scale
    replay: Replay


def init(key: PRNGKeyArray, recipe: Recipe) -> Learner:
    algorithm_key, credit_key = jax.random.split(key)
    return Learner(
        td3.init(algorithm_key, recipe.observation_size, recipe.action_size, recipe.td3),
        None
        if recipe.method.encoder is None
        else decomposition.init(
            credit_key, recipe.features, recipe.method, recipe.credit, steps=recipe.longest_episode, agents=1
        ),
        no_scale(),
        replay.empty(recipe.capacity, recipe.observation_size, recipe.action_size, recipe.factors),
    )


def features(steps: Step | Draw, method: Method) -> Float[Array, "batch features"]:
    """What the method's decoder sees of some steps."""
    if method.encoder is Encoder.LATENT:
        return jnp.asarray(steps.factors)
    change = steps.observation - steps.next_observation
    return jnp.concatenate([steps.observation, steps.action, change], axis=-1)


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
        credit = decomposition.observe_steps(credit, features(steps, recipe.method))
        credit = decomposition.observe_returns(credit, mean_reward, finished)
    return learner._replace(credit=credit, scale=observe_scale(learner.scale, mean_reward, finished), replay=held)


class Draws(NamedTuple):
    """Which transitions one update reads. Only numbers; the rows are read when the update runs."""

    batch: Int[Array, "*updates batch"]
    credit: "CreditDraws | None"


class CreditDraws(NamedTuple):
    """Which steps one update of the decoder reads, and of which episodes (`episode` as in `Episodes`)."""

    steps: Int[Array, "*updates rows"]
    episode: Int[Array, "*updates rows"]
    episodes: replay.EpisodeDraw


def draw(held: Replay, key: PRNGKeyArray, updates: int, recipe: Recipe) -> Draws:
    """Decide for a whole chunk of updates what each of them reads."""
    batch_key, credit_key = jax.random.split(key)
    batch = replay.draw_transitions(held, batch_key, (updates, recipe.td3.batch_size))
    if recipe.method.fit is None:
        return Draws(batch, None)
    if recipe.method.fit is Fit.ALL_STEPS:
        whole = partial(draw_whole_episodes, held, recipe=recipe)
        return Draws(batch, jax.vmap(whole)(jax.random.split(credit_key, updates)))
    return Draws(batch, draw_parts_of_episodes(held, credit_key, updates, recipe))


def draw_parts_of_episodes(held: Replay, key: PRNGKeyArray, updates: int, recipe: Recipe) -> CreditDraws:
    """K steps of each of `steps // K` episodes, for RRD."""
    episodes_key, steps_key = jax.random.split(key)
    drawn, count = recipe.credit.drawn_steps, max(1, recipe.credit.steps // recipe.credit.drawn_steps)
    episodes = replay.draw_episodes(held, episodes_key, (updates, count))
    steps = episodes.first[..., None] + replay.draw_steps(steps_key, episodes.length, drawn)
    episode = jnp.broadcast_to(jnp.repeat(jnp.arange(count), drawn), (updates, count * drawn))
    return CreditDraws(steps.reshape(updates, -1), episode, episodes)


def draw_whole_episodes(held: Replay, key: PRNGKeyArray, recipe: Recipe) -> CreditDraws:
    """All steps of max(1, steps // mean length) episodes, one behind the other, for RD.

    The rows are as many as the longest episode has, or `steps` if that is more; an episode that would run over the end
    is left out whole. Rows behind the last episode belong to none.
    """
    budget, places = max(recipe.credit.steps, recipe.longest_episode), recipe.credit.steps
    drawn = replay.draw_episodes(held, key, (places,))
    stored = replay.end_of(held, held.episodes - 1) - replay.oldest_transition(held)
    wanted = recipe.credit.steps * replay.finished(held) // jnp.maximum(stored, 1)
    end = jnp.cumsum(drawn.length)
    counts = drawn.counts * (jnp.arange(places) < jnp.maximum(wanted, 1)) * (end <= budget)
    row = jnp.arange(budget)
    place = jnp.minimum(jnp.searchsorted(end, row, side="right"), places - 1)
    step = drawn.first[place] + row - (end - drawn.length)[place]
    belongs = (counts[place] > 0) & (row < end[place])
    episodes = drawn._replace(counts=counts)
    return CreditDraws(jnp.where(belongs, step, drawn.first[0]), jnp.where(belongs, place, places), episodes)


def rewards(batch: Draw, learner: Learner, recipe: Recipe) -> Float[Array, " batch"]:
    """What the algorithm is trained on; proxy rewards always by the decoder as it stands."""
    match recipe.method.reward:
        case Reward.TRUE:
            reward = batch.reward
        case Reward.EPISODIC:
            reward = batch.episodic_reward
        case Reward.PROXY:
            assert learner.credit is not None
            reward = decomposition.proxy_rewards(learner.credit, features(batch, recipe.method), recipe.credit)
    return reward / magnitude(learner.scale) if recipe.scale_rewards else reward


def improve(
    learner: Learner, key: PRNGKeyArray, done: Int[Scalar, ""], updates: int, recipe: Recipe
) -> tuple[Learner, dict[str, Float[Array, ""]]]:
    """A chunk of updates; `done` is the number of those before it. Returns the mean of each metric over the chunk."""
    draw_key, noise_key = jax.random.split(key)
    held = learner.replay

    def one(carry: tuple[td3.TD3, Decomposition | None], turn: tuple[Int[Scalar, ""], Draws, PRNGKeyArray]):
        algorithm, credit = carry
        number, draws, key = turn
        measured = {}
        if credit is not None and draws.credit is not None and recipe.method.fit is not None:
            seen = features(replay.read(held, draws.credit.steps), recipe.method)
            chosen = draws.credit.episodes
            episodes = Episodes(seen, draws.credit.episode, chosen.length, chosen.mean_reward, chosen.counts)
            credit_key = jax.random.fold_in(key, 1)
            credit, measured = decomposition.update(credit, episodes, credit_key, recipe.method.fit, recipe.credit)
        batch = replay.read(held, draws.batch)
        reward = rewards(batch, learner._replace(credit=credit), recipe)
        batch = td3.Transitions(batch.observation, batch.action, reward, batch.next_observation, batch.continues)
        update_policy = (number + 1) % recipe.td3.policy_delay == 0
        algorithm, learned = td3.update(algorithm, batch, key, update_policy, recipe.td3)
        return (algorithm, credit), measured | learned

    turns = (done + jnp.arange(updates), draw(held, draw_key, updates, recipe), jax.random.split(noise_key, updates))
    (algorithm, credit), measured = jax.lax.scan(one, (learner.algorithm, learner.credit), turns)
    return learner._replace(algorithm=algorithm, credit=credit), jax.tree.map(jnp.mean, measured)


def assess(learner: Learner, steps: int, recipe: Recipe) -> dict[str, Float[Array, ""]]:
    """How near the newest decoder's proxy rewards come to the true ones, over the last `steps` steps."""
    if learner.credit is None:
        return {}
    held = learner.replay
    number = held.transitions - 1 - jnp.arange(steps)
    counts = number >= replay.oldest_transition(held)
    recent = replay.read(held, jnp.where(counts, number, replay.oldest_transition(held)))
    r_hat = decomposition.proxy_rewards(learner.credit, features(recent, recipe.method), recipe.credit)
    return {
        "credit/error": accuracy.mean_error(r_hat, recent.reward, counts),
        "credit/correlation": accuracy.correlation(r_hat, recent.reward, counts),
    }


class Compiled(NamedTuple):
    """The functions of a run, compiled, with a leading seed axis on every array but `done`."""

    store: Callable[..., Learner]
    improve: Callable[..., tuple[Learner, dict[str, Float[Array, " seeds"]]]]
    assess: Callable[..., dict[str, Float[Array, " seeds"]]]
    act: Callable[..., Array]


def compiled(recipe: Recipe, updates: int) -> Compiled:
    """`store` and `improve` consume the learner that they are given: its memory holds the new one."""
    return Compiled(
        store=jax.jit(jax.vmap(partial(store, recipe=recipe)), donate_argnums=0),
        improve=jax.jit(
            jax.vmap(partial(improve, updates=updates, recipe=recipe), in_axes=(0, 0, None)), donate_argnums=0
        ),
        assess=jax.jit(jax.vmap(partial(assess, steps=RECENT, recipe=recipe))),
        act=jax.jit(jax.vmap(td3.act)),
    )
