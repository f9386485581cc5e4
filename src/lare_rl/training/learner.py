"""The training state: the stored steps, the data that the decoders are fitted to, the rewards of the algorithm.

Only here do credit and algorithm meet: `credit` does not know the algorithm, and the algorithm does not know which method computes
its rewards. A team is a group of agents that share a return, and each team has its own decoder. The updates of the algorithms are
in `off_policy.py`, `on_policy.py` and `sequences.py`, by the data that they consume.

Functions are written for one seed; `compiled.py` gives them their leading seed axis.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.credit import accuracy, decomposition, descent
from lare_rl.credit import prequential as prediction
from lare_rl.credit.decoder_settings import RECENT
from lare_rl.credit.decomposition import Decomposition, Episodes
from lare_rl.credit.methods import Encoder, Fit, Reward
from lare_rl.data import replay
from lare_rl.data.replay import Replay, StoredSteps
from lare_rl.data.sampling import CreditSample, sample_packed, sample_padded, sample_parts
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import alive_mean, team_mean
from lare_rl.nn.normalise import Scale, magnitude, new_scale, observe_scale, within_range
from lare_rl.phi.graph import Graph
from lare_rl.tasks.spec import judged_states
from lare_rl.training.factors import step_factors
from lare_rl.training.static_config import TrainConfig

PART = 2400
"""About how many rows of features each part of a decoder's gradient is computed from. More rows do not fit into the cache, and
fewer make the matrix products inefficient. On one core, 256 episodes of six agents at once took 1.5 times as long."""


class Learner(NamedTuple):
    """The whole training state of one seed."""

    algorithm: Any
    """The state of the algorithm."""
    credit: tuple[Decomposition, ...]
    """The decoders, one for each team; empty for a method that fits nothing."""
    scale: tuple[Scale, ...]
    """The scale of each team's R/T."""
    replay: Replay
    counted: Int[Array, " envs"]
    """Finished episodes of each environment that the decoders have learned from."""


class Paid(NamedTuple):
    """The state from which rewards are computed."""

    credit: tuple[Decomposition, ...]
    scale: tuple[Scale, ...]


def init_credit(keys: Sequence[PRNGKeyArray], config: TrainConfig) -> tuple[Decomposition, ...]:
    """Untrained decoders, one for each team."""
    if config.method.reward is not Reward.PROXY:
        return ()
    env = config.env
    return tuple(
        decomposition.init(
            key,
            basis,
            config.method,
            config.credit,
            steps=env.max_steps,
            agents=1 if config.of_state else team.size,
            forms=config.forms,
        )
        for key, basis, team in zip(keys, config.bases, env.teams, strict=True)
    )


def init(key: PRNGKeyArray, config: TrainConfig, algorithm: Any) -> Learner:
    """An untrained learner. `algorithm` makes the algorithm's part from a key."""
    teams = len(config.env.teams)
    algorithm_key, *keys = jax.random.split(key, 1 + teams)
    return Learner(
        algorithm(algorithm_key),
        init_credit(keys, config),
        tuple(new_scale() for _ in config.env.teams),
        replay.empty(config.columns, config.environments, config.capacity, teams),
        jnp.zeros(config.environments, jnp.int32),
    )


def features(steps: StoredSteps, config: TrainConfig, place: int) -> Float[Array, "*batch rows features"]:
    """The inputs of a team's decoder for some steps."""
    rows, encoder, found = config.judged(place), config.method.encoder, []
    if config.method.latent:
        found.append(steps.before["factors"][..., rows, : config.factors[place]])
    if encoder is not Encoder.LATENT:
        found += raw_features(steps, config, rows)
    return jnp.concatenate(found, axis=-1)


def raw_features(steps: StoredSteps, config: TrainConfig, rows: slice) -> list[Float[Array, "*batch rows _"]]:
    """The raw part of a decoder's inputs for some steps."""
    before, after, encoder = steps.before, steps.after, config.method.encoder
    name = "state" if config.of_state else "observation"
    shown, led_to = (
        part[name][..., None, :] if config.of_state else part[name][..., rows, :] for part in (before, after)
    )
    if encoder is Encoder.RAW and not config.raw_differences:
        return [led_to]
    # A Gaussian may choose an action beyond the bounds; the environment then took the bound.
    action = jnp.clip(before["action"], -1, 1)
    action = action.reshape(*action.shape[:-2], 1, -1) if config.of_state else action[..., rows, :]
    match encoder:
        case Encoder.RAW:
            return [shown, action, shown - led_to]
        case Encoder.STATE_ACTION:
            return [shown, action]
        case Encoder.JUDGED | Encoder.LATENT_AND_JUDGED:
            return [*judged_states(config.judges, shown, led_to), action]
        case _:
            return [led_to, action]


def alive(steps: StoredSteps, config: TrainConfig) -> Bool[Array, "*batch agents"]:
    """Which agents acted."""
    if "alive" in steps.before:
        return steps.before["alive"]
    return jnp.ones((*steps.finished.shape, config.env.agents), bool)


def alive_rows(steps: StoredSteps, config: TrainConfig, place: int) -> Bool[Array, "*batch rows"] | None:
    """Which of a team's judged rows count; None if all always do."""
    if "alive" not in steps.before or config.of_state:
        return None
    return steps.before["alive"][..., config.judged(place)]


def store(
    learner: Learner, steps: Trajectory, config: TrainConfig, phi: Sequence[Graph] = ()
) -> tuple[Learner, Bool[Array, ""]]:
    """Compute the factors of new steps, and put both into the replay and into the running statistics.

    Args:
        learner: the learner.
        steps: the new steps.
        config: the configuration of the run.
        phi: the graph of each team's phi.

    Returns:
        The new learner, and whether all factors are finite.
    """
    factors = step_factors(phi, steps, config)
    return store_with_factors(learner, steps, factors, config), jnp.all(jnp.isfinite(factors))


def store_with_factors(
    learner: Learner, steps: Trajectory, factors: Float[Array, "time envs rows factors"], config: TrainConfig
) -> Learner:
    """Put new steps into the replay and into the running statistics."""
    buffer = replay.extend(learner.replay, *rows_of(steps, factors, config), team_rewards(steps, config), steps.ended)
    ended = jnp.asarray(steps.ended)
    new = replay.read(buffer, replay.newest(buffer, len(ended)))
    new = jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), new)
    scale = tuple(
        observe_scale(one, new.mean_reward[..., place].ravel(), ended.ravel())
        for place, one in enumerate(learner.scale)
    )
    credit = tuple(with_steps(one, new, ended, config, place) for place, one in enumerate(learner.credit))
    return learner._replace(credit=credit, scale=scale, replay=buffer)


def rows_of(steps: Trajectory, factors: Array, config: TrainConfig) -> tuple[dict[str, Any], dict[str, Any]]:
    """The replay's columns for new steps, before and after each step."""
    there = {
        **{name: getattr(steps.before, name) for name in replay.SHOWN},
        "action": steps.action,
        "factors": factors,
        "reward": steps.after.reward,
        "terminated": steps.after.terminated,
    }
    columns = config.columns
    before = {name: there[name] for name in columns}
    return before, {name: getattr(steps.after, name) for name in replay.SHOWN if name in columns}


def team_rewards(steps: Trajectory, config: TrainConfig) -> Float[Array, "time envs teams"]:
    """The reward of each team for each step."""
    of_each = (team_mean(steps.after.reward, steps.before.alive, team) for team in config.env.teams)
    return jnp.stack(list(of_each), axis=-1)


def with_steps(
    credit: Decomposition, steps: StoredSteps, ended: Bool[Array, "time envs"], config: TrainConfig, place: int
) -> Decomposition:
    """A team's decoder with new steps in its statistics."""
    rows, mask = features(steps, config, place), alive_rows(steps, config, place)
    credit = decomposition.observe_steps(credit, rows, mask)
    mean_reward = steps.mean_reward[..., place].ravel()
    return decomposition.observe_returns(credit, mean_reward, steps.length.ravel(), ended.ravel())


def shares(mask: Bool[Array, "*batch rows"]) -> Float[Array, "*batch rows"]:
    """1/n for each of n agents that are alive, else 0."""
    return mask / jnp.maximum(jnp.sum(mask, axis=-1, keepdims=True), 1)


def forget_episodes(learner: Learner, dropped: Bool[Array, " envs"]) -> Learner:
    """The learner without the running episodes of some environments."""
    return learner._replace(replay=replay.drop_running(learner.replay, dropped))


def sample_credit(buffer: Replay, key: PRNGKeyArray, updates: int, config: TrainConfig) -> CreditSample | None:
    """Choose the steps that each of some updates of the decoders reads; None for a method without such updates."""
    fit, credit, longest = config.method.fit, config.credit, config.env.max_steps
    if fit is None or not config.method.descends:
        return None
    if fit is Fit.SUBTRAJECTORIES:
        return sample_padded(buffer, key, updates, credit.episodes, longest)
    if fit.draws_steps:
        drawn = min(credit.drawn_steps, longest)
        return sample_parts(buffer, key, updates, parts_count(config), drawn)
    if config.env.fixed_length:
        return sample_padded(buffer, key, updates, parts_count(config), longest)
    return sample_packed(buffer, key, updates, credit.steps, longest)


def parts_count(config: TrainConfig) -> int:
    """The number of episodes in an update: whole episodes if all have the same length, else with `drawn_steps` steps of each."""
    longest = config.env.max_steps
    return max(1, config.credit.steps // (longest if config.env.fixed_length else config.credit.drawn_steps))


def fit(
    credit: tuple[Decomposition, ...], buffer: Replay, sample: CreditSample, key: PRNGKeyArray, config: TrainConfig
) -> tuple[tuple[Decomposition, ...], dict[str, Float[Array, ""]]]:
    """One update of every team's decoder."""
    assert config.method.fit is not None
    steps = replay.read(buffer, sample.steps)
    fitted, measured = [], []
    for place, (one, own) in enumerate(zip(credit, jax.random.split(key, len(credit)), strict=True)):
        new, metrics = update_decoder(one, episodes_of(steps, sample, config, place), own, config)
        fitted.append(new)
        measured.append(metrics)
    return tuple(fitted), by_team(measured, config)


def episodes_of(steps: StoredSteps, sample: CreditSample, config: TrainConfig, place: int) -> Episodes:
    """The batch of a team's decoder, from the chosen steps."""
    mask, chosen = alive_rows(steps, config, place), sample.episodes
    return Episodes(
        features(steps, config, place),
        sample.episode,
        chosen.length,
        chosen.mean_reward[..., place],
        chosen.mask,
        None if mask is None else shares(mask),
    )


def update_decoder(
    credit: Decomposition, batch: Episodes, key: PRNGKeyArray, config: TrainConfig
) -> tuple[Decomposition, dict[str, Float[Array, ""]]]:
    """One gradient step. The gradient of a large batch of equally long episodes is computed in parts."""
    assert config.method.fit is not None
    rows, count = batch.features[..., 0].size, len(batch.length)
    parts = 1
    if config.env.fixed_length and rows > PART:
        fitting = max(1, PART * count // rows)
        parts = min(parts for parts in range(1, count + 1) if count % parts == 0 and count // parts <= fitting)
    if parts == 1:
        return descent.update(credit, batch, key, config.method.fit, config.credit)
    # Every part counts its episodes from 0.
    batch = batch._replace(episode=batch.episode % (count // parts))
    batch = jax.tree.map(lambda whole: whole.reshape(parts, -1, *whole.shape[1:]), batch)
    return descent.update_in_parts(credit, batch, key, config.method.fit, config.credit)


def fit_often(
    learner: Learner, key: PRNGKeyArray, config: TrainConfig
) -> tuple[tuple[Decomposition, ...], dict[str, Float[Array, ""]]]:
    """`fit_updates` updates of the decoders, one after the other; the mean of each metric over them."""
    sample_key, key = jax.random.split(key)
    samples = sample_credit(learner.replay, sample_key, config.fit_updates, config)
    if samples is None:
        return learner.credit, {}

    def one(credit: tuple[Decomposition, ...], update: tuple[CreditSample, PRNGKeyArray]):
        return fit(credit, learner.replay, *update, config)

    credit, measured = jax.lax.scan(one, learner.credit, (samples, jax.random.split(key, config.fit_updates)))
    return credit, jax.tree.map(jnp.mean, measured)


def rewards(steps: StoredSteps, paid: Paid, config: TrainConfig) -> Float[Array, "*batch agents"]:
    """The rewards that the algorithm is trained on, for each agent. Proxy rewards are always by the current decoders."""
    acting, parts = alive(steps, config), []
    for place, team in enumerate(config.env.teams):
        shape = (*steps.finished.shape, team.size)
        match config.method.reward:
            case Reward.TRUE:
                part = steps.before["reward"][..., team.agents]
            case Reward.EPISODIC:
                part = steps.episodic_reward[..., place, None]
            case _:
                part = proxy_rewards(steps, paid, config, place, as_paid=True)
        part = jnp.broadcast_to(part, shape)
        if config.method.shared:
            part = jnp.broadcast_to(alive_mean(part, acting[..., team.agents])[..., None], shape)
        if "alive" in steps.before:
            part = jnp.where(acting[..., team.agents], part, 0)
        parts.append(part / magnitude(paid.scale[place]) if config.scale_rewards else part)
    return jnp.concatenate(parts, axis=-1)


def proxy_rewards(
    steps: StoredSteps, paid: Paid, config: TrainConfig, place: int, *, as_paid: bool = False
) -> Float[Array, "*batch rows"]:
    """r_hat of a team, for a method that has one: for each of its agents, or one for all. `as_paid` adds optimism, if it is set."""
    if config.method.reward is Reward.DESIGNED:
        return steps.before["factors"][..., config.judged(place), 0]
    if config.method.reward is Reward.UNIFORM:
        # The return of a running episode is not known yet.
        share = within_range(paid.scale[place], steps.mean_reward[..., place])
        return jnp.where(steps.finished, share, 0.5)[..., None]
    rows = features(steps, config, place)
    flat = rows.reshape(-1, *rows.shape[-2:])
    optimistic = as_paid and decomposition.optimistic(config.method, config.credit)
    found = decomposition.optimistic_rewards if optimistic else decomposition.proxy_rewards
    r_hat = found(paid.credit[place], flat, config.credit, steps.length.ravel())
    return r_hat.reshape(rows.shape[:-1])


def assess(learner: Learner, config: TrainConfig) -> dict[str, Float[Array, ""]]:
    """How close the newest proxy rewards are to the true ones, over the last steps of every environment."""
    if not config.method.has_proxy:
        return {}
    buffer, found = learner.replay, []
    # Decoders of whole episodes need whole episodes: those of the newest iteration.
    count = config.rollout_steps if config.env.fixed_length else max(1, RECENT // config.environments)
    index = replay.newest(buffer, min(replay.capacity(buffer) - 1, count))
    oldest = replay.oldest_transition(buffer)[:, None]
    there = index.number >= oldest
    recent = replay.read(buffer, index._replace(number=jnp.maximum(index.number, oldest)))
    paid = Paid(learner.credit, learner.scale)
    for place, team in enumerate(config.env.teams):
        true, acting = recent.before["reward"], alive(recent, config)
        if config.of_state:
            true, mask = team_mean(true, acting, team)[..., None], there[..., None]
        else:
            true, mask = true[..., team.agents], there[..., None] & acting[..., team.agents]
        r_hat, last = (
            jnp.broadcast_to(values, true.shape)
            for values in (proxy_rewards(recent, paid, config, place), recent.last[..., None])
        )
        compared = (values.ravel() for values in (r_hat, true, last, mask))
        found.append(accuracy.metrics(*compared, in_reward_units=config.method.in_reward_units))
        if learner.credit:
            credit = learner.credit[place]
            found[-1]["credit/return_r2"] = prediction.r2(credit.predictions)[0]
            if credit.rivals is not None:
                found[-1]["credit/average"] = credit.average.astype(jnp.float32)
    return by_team(found, config)


def by_team(measured: list[dict[str, Array]], config: TrainConfig) -> dict[str, Array]:
    """The metrics of all teams: those of the first and, if there are several, those of each team under its own name, too."""
    teams = zip(config.env.teams, measured, strict=True) if len(measured) > 1 else ()
    return measured[0] | {f"{name}_{team.name}": value for team, own in teams for name, value in own.items()}
