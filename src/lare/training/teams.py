"""The compiled parts of training many agents: play, store, fit the decoders, improve the policy.

Algorithm 1 of the LaRe paper, lines 6 to 8, for on-policy algorithms. For many agents this is where credit and algorithm
meet, as `learner.py` is for one. Between `play` and `store` the host runs `phi`, once on everything that was played.

A *team* is the agents that share a return: the mean over them of the sums of their true rewards, known at the end of the
episode only. Each team has a decoder of its own; all agents share one actor and one critic, which are told who they act
for where there are several teams.

Functions are written for one seed; `compiled` gives them their leading seed axis.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PRNGKeyArray, Scalar

from lare.algorithms import ppo
from lare.algorithms.ppo import PPO, Policy, PPOSettings
from lare.credit import accuracy, decomposition
from lare.credit.decomposition import Decomposition, Episodes
from lare.credit.methods import Encoder, Fit, Method, Reward
from lare.normalise import no_scale, observe_scale, within_range
from lare.tasks.particles.task import ACTIONS, STEPS, ParticleTask, Team
from lare.tasks.particles.world import State
from lare.training import episodes as replay
from lare.training.episodes import EpisodeReplay
from lare.training.replay import draw_steps
from lare.training.settings import AgentSettings

PART = 2400
"""Rows of features, about, over which one part of a decoder's gradient is computed. More fall out of the cache, fewer keep
the matrix products waiting; on one core 256 episodes of six agents at once took 1.5 times as long."""


@dataclass(frozen=True)
class Recipe:
    """What is to be trained and how: everything that the compiled functions hold fixed."""

    task: ParticleTask
    method: Method
    ppo: PPOSettings
    agents: AgentSettings
    factors: tuple[int, ...]
    """Of each team's latent function; empty for a method that needs none."""

    @property
    def features(self) -> tuple[int, ...]:
        """Size of what each team's decoder sees."""
        match self.method.encoder:
            case None:
                return (0,) * len(self.task.teams)
            case Encoder.LATENT:
                return self.factors
            case Encoder.RAW:
                return (self.task.observation_size,) * len(self.task.teams)
            case Encoder.TAKEN:
                return (self.task.observation_size + ACTIONS,) * len(self.task.teams)

    @property
    def policy_input(self) -> int:
        """Size of what actor and critic see."""
        return self.task.observation_size + (self.task.agents if len(self.task.teams) > 1 else 0)


class Learner(NamedTuple):
    """The whole training state of one seed."""

    algorithm: PPO
    credit: tuple[Decomposition, ...]
    """One for each team; none for a method that fits nothing."""
    replay: EpisodeReplay


class Played(NamedTuple):
    """Whole episodes."""

    observation: Float[Array, "*seeds steps episodes agents observation"]
    action: Float[Array, "*seeds steps episodes agents action"]
    """Rows with a single 1."""
    next_observation: Float[Array, "*seeds steps episodes agents observation"]
    reward: Float[Array, "*seeds steps episodes agents"]
    """True."""
    position: Float[Array, "*seeds steps episodes entities 2"]
    """Of everything, after each step."""


def init(key: PRNGKeyArray, recipe: Recipe) -> Learner:
    algorithm_key, *keys = jax.random.split(key, 1 + len(recipe.task.teams))
    task, settings = recipe.task, recipe.agents
    credit = tuple(
        decomposition.init(key, size, recipe.method, settings.credit, STEPS, team.stop - team.start)
        for key, size, team in zip(keys, recipe.features, task.teams, strict=True)
        if recipe.method.fit is not None
    )
    return Learner(
        ppo.init(algorithm_key, recipe.policy_input, ACTIONS, True, recipe.ppo),
        credit,
        replay.empty(settings.capacity, STEPS, task.agents, max(recipe.features)),
    )


def seen(
    observation: Float[Array, "*batch agents observation"], recipe: Recipe
) -> Float[Array, "*batch agents policy_input"]:
    """What actor and critic see: the observation and, where there are several teams, which agent it is."""
    if recipe.policy_input == recipe.task.observation_size:
        return observation
    number = jnp.broadcast_to(jnp.eye(recipe.task.agents), (*observation.shape[:-1], recipe.task.agents))
    return jnp.concatenate([observation, number], axis=-1)


def play(policy: Any, key: PRNGKeyArray, count: int, recipe: Recipe) -> Played:
    """Whole episodes of a policy: of whatever has the `sample` of `ppo.Policy`."""
    task = recipe.task
    start_key, key = jax.random.split(key)
    start = jax.vmap(task.reset)(jax.random.split(start_key, count))

    def one(carry: tuple[State, Array], key: PRNGKeyArray):
        state, observation = carry
        action_key, step_key = jax.random.split(key)
        action = policy.sample(seen(observation, recipe), action_key)
        keys = jax.random.split(step_key, count)
        state = jax.vmap(task.step)(state, jnp.argmax(action, axis=-1), keys)
        after = jax.vmap(task.observe)(state)
        return (state, after), Played(observation, action, after, jax.vmap(task.reward)(state), state.position)

    return jax.lax.scan(one, (start, jax.vmap(task.observe)(start)), jax.random.split(key, STEPS))[1]


def features(played: Played, factors: Float[Array, "steps episodes agents factors"], recipe: Recipe):
    """What the decoders see, episode by episode: (episodes, steps, agents, features), padded to the largest team's."""
    match recipe.method.encoder:
        case Encoder.RAW:
            rows = played.next_observation
        case Encoder.TAKEN:
            rows = jnp.concatenate([played.observation, played.action], axis=-1)
        case _:
            rows = factors
    return jnp.swapaxes(rows, 0, 1)


def of_team(
    rows: Float[Array, "episodes steps agents widest"], team: Team, size: int
) -> Float[Array, "rows team features"]:
    """A team's features, its episodes one behind the other."""
    return rows[..., team.start : team.stop, :size].reshape(-1, team.stop - team.start, size)


def mean_rewards(reward: Float[Array, "episodes steps agents"], team: Team) -> Float[Array, " episodes"]:
    """R/T of a team, R the mean over its agents of their returns."""
    return jnp.mean(reward[..., team.start : team.stop], axis=(1, 2))


def store(learner: Learner, played: Played, factors: Array, recipe: Recipe) -> Learner:
    """Put new episodes into the replay and into the running statistics."""
    rows = features(played, factors, recipe)
    reward = jnp.swapaxes(played.reward, 0, 1)
    credit = []
    decoders = zip(learner.credit, recipe.task.teams, recipe.features, strict=True) if learner.credit else ()
    for one, team, size in decoders:
        one = decomposition.observe_steps(one, of_team(rows, team, size))
        means = mean_rewards(reward, team)
        whole = jnp.ones_like(means, bool)
        one = decomposition.observe_returns(one, means, whole)
        if recipe.method.fit is not None and recipe.method.fit.closed_form:
            # An episode's steps and agents count alike: as one step, it is their mean.
            mean_step = jnp.mean(of_team(rows, team, size).reshape(len(means), -1, size), axis=1)
            way, settings = recipe.method.fit, recipe.agents.credit
            one = decomposition.fit_in_closed_form(one, mean_step, means, whole, way, settings)
        credit.append(one)
    return learner._replace(credit=tuple(credit), replay=replay.extend(learner.replay, rows, reward))


def fit(
    learner: Learner, key: PRNGKeyArray, recipe: Recipe
) -> tuple[tuple[Decomposition, ...], dict[str, Float[Array, ""]]]:
    """Some updates of every team's decoder, each on episodes drawn anew; the mean of each metric over them."""
    assert recipe.method.fit is not None
    held, settings, way = learner.replay, recipe.agents.credit, recipe.method.fit
    count = max(1, settings.steps // STEPS)
    drawn = STEPS if way is Fit.ALL_STEPS else min(settings.drawn_steps, STEPS)
    fitting = max(1, PART // (drawn * recipe.task.agents))
    parts = min(parts for parts in range(1, count + 1) if count % parts == 0 and count // parts <= fitting)
    length, ones = jnp.full(count, STEPS), jnp.ones(count)

    def one(credit: tuple[Decomposition, ...], key: PRNGKeyArray):
        draw_key, steps_key, key = jax.random.split(key, 3)
        chosen = replay.draw(held, draw_key, (count,))
        rows, reward = held.features[chosen], held.reward[chosen]
        if way is not Fit.ALL_STEPS:
            steps = draw_steps(steps_key, length, drawn)
            rows = jnp.take_along_axis(rows, steps[..., None, None], axis=1)
        episode = jnp.tile(jnp.repeat(jnp.arange(count // parts), drawn), parts)
        fitted, losses, keys = [], [], jax.random.split(key, len(credit))
        for old, team, size, key in zip(credit, recipe.task.teams, recipe.features, keys, strict=True):
            batch = Episodes(of_team(rows, team, size), episode, length, mean_rewards(reward, team), ones)
            batch = jax.tree.map(lambda whole: whole.reshape(parts, -1, *whole.shape[1:]), batch)
            new, measured = decomposition.update_in_parts(old, batch, key, way, settings)
            fitted.append(new)
            losses.append(measured)
        return tuple(fitted), by_team(losses, recipe.task)

    credit, measured = jax.lax.scan(one, learner.credit, jax.random.split(key, recipe.agents.fit_updates))
    return credit, jax.tree.map(jnp.mean, measured)


def rewards(
    learner: Learner, rows: Array, reward: Float[Array, "episodes steps agents"], recipe: Recipe
) -> Float[Array, "episodes steps agents"]:
    """What the policy is trained on; proxy rewards always by the decoders as they stand."""
    parts = []
    for place, (team, size) in enumerate(zip(recipe.task.teams, recipe.features, strict=True)):
        shape = (*reward.shape[:2], team.stop - team.start)
        match recipe.method.reward:
            case Reward.TRUE:
                part = reward[..., team.start : team.stop]
            case Reward.EPISODIC:
                total = STEPS * mean_rewards(reward, team)
                part = jnp.zeros(shape).at[:, -1].set(total[:, None])
            case Reward.PROXY:
                credit = learner.credit[place]
                part = decomposition.proxy_rewards(credit, of_team(rows, team, size), recipe.agents.credit)
                part = part.reshape(shape)
            case Reward.UNIFORM:
                part = jnp.broadcast_to(uniform(learner.replay, reward, team)[:, None, None], shape)
            case Reward.DESIGNED:
                part = rows[..., team.start : team.stop, 0]
        if recipe.method.shared:
            part = jnp.broadcast_to(jnp.mean(part, axis=-1, keepdims=True), shape)
        parts.append(part)
    return jnp.concatenate(parts, axis=-1)


def uniform(
    held: EpisodeReplay, reward: Float[Array, "episodes steps agents"], team: Team
) -> Float[Array, " episodes"]:
    """R/T of episodes, between the lowest and the highest of those that are stored."""
    means = mean_rewards(held.reward, team)
    known = jnp.arange(len(means)) < held.next_row
    scale = observe_scale(no_scale(), means, known)
    return within_range(scale, mean_rewards(reward, team))


def improve(
    learner: Learner, played: Played, factors: Array, key: PRNGKeyArray, left: Float[Scalar, ""], recipe: Recipe
) -> tuple[Learner, dict[str, Float[Array, ""]]]:
    """Update the policy on what it has just played. The end of the time is the end of the task: it pays no more."""
    true = jnp.swapaxes(played.reward, 0, 1)
    reward = jnp.swapaxes(rewards(learner, features(played, factors, recipe), true, recipe), 0, 1)
    ended = jnp.zeros_like(reward).at[-1].set(1.0)

    def lanes(rows: Float[Array, "steps episodes agents *rest"]) -> Float[Array, "steps lanes *rest"]:
        return rows.reshape(STEPS, -1, *rows.shape[3:])

    before, after = (seen(rows, recipe) for rows in (played.observation, played.next_observation))
    rollout = ppo.Rollout(*map(lanes, (before, played.action, reward, after, 1 - ended, ended)))
    algorithm, measured = ppo.update(learner.algorithm, rollout, key, left, recipe.ppo)
    return learner._replace(algorithm=algorithm), measured


def assess(learner: Learner, recipe: Recipe) -> dict[str, Float[Array, ""]]:
    """How near the newest decoders' proxy rewards come to the true ones, over the episodes of the newest update."""
    if not recipe.method.has_proxy:
        return {}
    newest = replay.newest(learner.replay, recipe.agents.episodes)
    reward = learner.replay.reward[newest]
    r_hat, found = rewards(learner, learner.replay.features[newest], reward, recipe), []
    for team in recipe.task.teams:
        guess, true = (rows[..., team.start : team.stop].ravel() for rows in (r_hat, reward))
        found.append(accuracy.metrics(guess, true, jnp.ones(guess.shape, bool), recipe.method.in_units))
    return by_team(found, recipe.task)


def by_team(measured: Sequence[dict[str, Array]], task: ParticleTask) -> dict[str, Array]:
    """The metrics of all teams: those of the first and, where there are several, each team's under its own name too."""
    teams = zip(task.teams, measured, strict=True) if len(measured) > 1 else ()
    return measured[0] | {f"{name}_{team.name}": value for team, own in teams for name, value in own.items()}


def returns(reward: Float[Array, "*seeds steps episodes agents"], team: Team) -> Float[Array, "*seeds episodes"]:
    """True returns of a team: the sums over its agents."""
    return jnp.sum(reward[..., team.start : team.stop], axis=(-3, -1))


class Compiled(NamedTuple):
    """The functions of a run, compiled, with a leading seed axis on every array but `left`."""

    play: Callable[..., Played]
    """From policies, keys, and how many episodes of each."""
    store: Callable[..., Learner]
    fit: Callable[..., tuple[tuple[Decomposition, ...], dict[str, Float[Array, " seeds"]]]]
    improve: Callable[..., tuple[Learner, dict[str, Float[Array, " seeds"]]]]
    assess: Callable[..., dict[str, Float[Array, " seeds"]]]


def compiled(recipe: Recipe) -> Compiled:
    """`store` and `improve` consume the learner that they are given: its memory holds the new one."""

    def play_all(policy: Policy, keys: Key[Array, " seeds"], count: int) -> Played:
        return jax.vmap(partial(play, count=count, recipe=recipe))(policy, keys)

    def fit_in_turn(learner: Learner, keys: Key[Array, " seeds"]):
        # A batch of 256 episodes fills the caches as it is: in lockstep the seeds would only be in each other's way.
        return jax.lax.map(lambda one: fit(one[0], one[1], recipe), (learner, keys))

    return Compiled(
        play=jax.jit(play_all, static_argnums=2),
        store=jax.jit(jax.vmap(partial(store, recipe=recipe)), donate_argnums=0),
        fit=jax.jit(fit_in_turn),
        improve=jax.jit(jax.vmap(partial(improve, recipe=recipe), in_axes=(0, 0, 0, 0, None)), donate_argnums=0),
        assess=jax.jit(jax.vmap(partial(assess, recipe=recipe))),
    )
