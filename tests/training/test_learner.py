"""Fits and rewards of each method: for one agent, for many, for teams, and with agents that leave."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.long_tests import long_case
from helpers.numpy_twins import assert_close
from helpers.small_configs import (
    LENGTHS,
    ONE_TEAM,
    TOTAL,
    TWO_TEAMS,
    add_steps,
    jitted,
    learner_with_episodes,
    random_factors,
    random_steps,
    small_config,
    stored_steps,
    team_rewards,
    untrained_learner,
    with_factor_decoders,
    with_other_dead_values,
)
from lare_rl.credit import evidence
from lare_rl.credit.rewards import proxy_rewards
from lare_rl.nn.normalise import root_mean_square
from lare_rl.training.decoder_fits import sample_credit, update_decoders
from lare_rl.training.decoder_inputs import step_batch
from lare_rl.training.learner import abandon_episodes
from lare_rl.training.rewards import assess, rewards

ENDS = np.cumsum(LENGTHS)[:-1]
MANY = partial(small_config, algorithm="ippo", env=ONE_TEAM)
TEAMS = partial(small_config, algorithm="ippo", env=TWO_TEAMS)


def team_proxy_rewards(steps, decoders, config):
    return proxy_rewards(decoders[0], step_batch(steps, config, 0), config.credit_specs[0])


def update_once(learner, config, key=0):
    """Return the decoders after one update, and its metrics."""
    samples = sample_credit(learner.replay, jax.random.key(key), 1, config)
    sample = jax.tree.map(lambda leaf: leaf[0], samples)
    return jitted(update_decoders, config)(learner.decoders, learner.replay, sample, jax.random.key(1))


@pytest.mark.parametrize(
    ("method", "scale_rewards"),
    [("dense", True), ("lare-rrdu", False), long_case("lare-rrdu", True), ("llm-reward", True)],
)
def test_rewards(method, scale_rewards):
    config = small_config(method, scale_rewards=scale_rewards)
    learner, steps = learner_with_episodes(config), random_steps()
    unit = root_mean_square(learner.decoders[0].scale) if scale_rewards else 1
    reward = jitted(rewards, config)(stored_steps(learner), learner.decoders)
    assert reward.shape == (TOTAL, 1)
    reward = np.asarray(reward)[:, 0] * unit
    match method:
        case "dense":
            np.testing.assert_allclose(reward, steps.next_timestep.reward.ravel(), rtol=1e-5)
        case "llm-reward":
            np.testing.assert_allclose(reward, random_factors(config, steps)[:, 0, 0, 0], rtol=1e-5)
        case _:
            r_hat = jitted(team_proxy_rewards, config)(stored_steps(learner), learner.decoders)
            np.testing.assert_allclose(reward, r_hat[:, 0], rtol=1e-5)
            assert reward.std() > 0


def check_closed_form(credit, z, reward):
    """Check the sums over episodes, weighted by their steps, of standardised factors, 1/T, R/T and R. NaN: no agent was alive."""
    decoder = credit.closed_form.decoder
    standard = [np.nan_to_num((rows - np.asarray(decoder.mean)) / np.asarray(decoder.std)) for rows in z]
    v = [[*rows.mean(axis=0), 1 / len(r), r.mean(), r.sum()] for rows, r in zip(standard, reward, strict=True)]
    length = np.array([len(rows) for rows in z])
    centred = np.array(v) - np.average(v, axis=0, weights=length)
    with jax.enable_x64(True):
        sums = evidence.to_float64(credit.closed_form.sufficient_statistics)
    assert (float(sums.n_episodes), float(sums.n_steps)) == (len(z), length.sum())
    np.testing.assert_allclose(sums.mean, np.average(v, axis=0, weights=length), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(sums.products, (length * centred.T) @ centred, rtol=1e-3, atol=1e-4)


def test_assess_reads_the_newest_steps():
    # The factor is the true reward of the newest ten steps, and far from it before.
    config, steps = small_config("lare-linear", n_factors=(1,), rollout_steps=10), random_steps()
    offset = np.where(np.arange(TOTAL) < TOTAL - 10, 7.0, 0.5).astype(np.float32)
    factors = steps.next_timestep.reward[..., None] + offset[:, None, None, None]
    learner = with_factor_decoders(add_steps(untrained_learner(config), config, steps, factors, learn=False), [1.0])
    # With a fixed length, only the newest iteration is measured.
    same_length = replace(config, env=replace(config.env, fixed_length=True))
    for reader, error in ((same_length, 0.5), (config, (7 * (TOTAL - 10) + 5) / TOTAL)):
        metrics = jitted(assess, reader)(learner)
        assert float(metrics["credit/error"]) == pytest.approx(error, rel=1e-5)
        assert reader is config or float(metrics["credit/correlation"]) == pytest.approx(1, rel=1e-4)


def test_teams_have_separate_decoders_and_returns():
    config, steps = TEAMS("lare-rd"), random_steps(TWO_TEAMS)
    learner = learner_with_episodes(config)
    factors, alive = random_factors(config, steps)[:, 0], steps.timestep.alive[:, 0]
    for credit, team, size in zip(learner.decoders, TWO_TEAMS.teams, (2, 3), strict=True):
        rows = factors[:, team.agents, :size][alive[:, team.agents]]
        np.testing.assert_allclose(credit.statistics.mean, rows.mean(axis=0), rtol=1e-4)
        assert float(credit.statistics.n_rows) == len(rows)
        means = np.array([episode.mean() for episode in np.split(team_rewards(steps, team), ENDS)])
        assert float(credit.scale.mean_square) == pytest.approx(float((means**2).mean()), rel=1e-4)
    updated, _ = update_once(learner, config)
    for before, after in zip(learner.decoders, updated, strict=True):
        assert not jax.tree.all(jax.tree.map(jnp.array_equal, before.network, after.network))


def with_running_episode(config):
    """Return a learner with a running episode of two steps, and the learner without it."""
    learner, steps = learner_with_episodes(config), jax.tree.map(lambda rows: rows[:2], random_steps(config.env))
    return add_steps(learner, config, steps), learner


@pytest.mark.parametrize("method", ["episodic", "ircr"])
def test_rewards_of_teams(method):
    """ircr pays half until an episode ends."""
    config, steps = TEAMS(method), random_steps(TWO_TEAMS)
    (learner, _), alive = with_running_episode(config), steps.timestep.alive[:, 0]
    reward = np.asarray(jitted(rewards, config)(stored_steps(learner), learner.decoders))
    np.testing.assert_array_equal(reward[TOTAL:], alive[:2] * (0.5 if method == "ircr" else 0))
    assert not alive.all()
    for team in TWO_TEAMS.teams:
        episode_rewards = np.split(team_rewards(steps, team), ENDS)
        if method == "episodic":
            sums = np.repeat([episode.sum() for episode in episode_rewards], LENGTHS)
            expected = np.where(steps.ended, sums[:, None], 0)
        else:
            means = np.array([episode.mean() for episode in episode_rewards])
            expected = np.repeat((means - means.min()) / (means.max() - means.min()), LENGTHS)[:, None]
        expected = expected * alive[:, team.agents]
        np.testing.assert_allclose(reward[:TOTAL, team.agents], expected, rtol=1e-3, atol=1e-5)


def test_rewards_of_each_agent_and_shared_among_agents_that_are_alive():
    """r_hat of two teams is a different number for each row, negative for the second team."""
    config, steps = TEAMS("lare-linear", n_factors=(1, 1)), random_steps(TWO_TEAMS)
    number = np.arange(TOTAL * 5, dtype=np.float32).reshape(TOTAL, 1, 5)
    learner = with_factor_decoders(
        add_steps(untrained_learner(config), config, steps, number[..., None], learn=False), [1.0, -1.0]
    )
    r_hat, alive = number[:, 0] * np.repeat([1.0, -1.0], [3, 2]), steps.timestep.alive[:, 0]
    stored, state = stored_steps(learner), learner.decoders
    np.testing.assert_array_equal(jitted(rewards, config)(stored, state), r_hat * alive)
    shared = replace(config, method=replace(config.method, shared=True))
    reward = np.asarray(jitted(rewards, shared)(stored, state))
    for row, row_alive, row_r_hat in zip(reward, alive, r_hat, strict=True):
        for team in TWO_TEAMS.teams:
            mask = row_alive[team.agents]
            expected = row_r_hat[team.agents][mask].mean() if mask.any() else 0
            np.testing.assert_allclose(row[team.agents], expected * mask, rtol=1e-5)


def test_assess_measures_each_team():
    # r_hat is the true reward in the first team and its negative in the second; of dead agents, another number.
    config, steps = TEAMS("lare-linear", n_factors=(1, 1)), random_steps(TWO_TEAMS)
    alive = steps.timestep.alive
    factors = np.where(alive, steps.next_timestep.reward, 1e3)[..., None]
    learner = add_steps(untrained_learner(config), config, steps, factors, learn=False)
    results = {
        name: float(value) for name, value in jitted(assess, config)(with_factor_decoders(learner, [1.0, -1.0])).items()
    }
    assert [results[f"credit/correlation{team}"] for team in ("", "_first", "_second")] == pytest.approx([1, 1, -1])
    error = 2 * np.abs(steps.next_timestep.reward[..., 3:][alive[..., 3:]]).mean()
    errors = [results[f"credit/error{team}"] for team in ("", "_first", "_second")]
    assert errors == pytest.approx([0, 0, error], rel=1e-4, abs=1e-6)


def test_closed_form_sums_means_over_alive_agents_of_finished_episodes():
    """To abandon a running episode changes nothing."""
    config, steps = TEAMS("lare-linear"), random_steps(TWO_TEAMS)
    factors, (longer, learner) = random_factors(config, steps), with_running_episode(config)
    shorter = abandon_episodes(longer, jnp.array([True]))
    assert shorter.replay.next_transition.tolist() == learner.replay.next_transition.tolist()
    for credit, team, size, before in zip(
        shorter.decoders, TWO_TEAMS.teams, config.n_factors, learner.decoders, strict=True
    ):
        jax.tree.map(np.testing.assert_array_equal, credit.closed_form, before.closed_form)
        all_rows, alive = factors[:, 0, team.agents, :size], steps.timestep.alive[:, 0, team.agents]
        rows = [
            z[mask].mean(axis=0) if mask.any() else [np.nan] * size for z, mask in zip(all_rows, alive, strict=True)
        ]
        check_closed_form(credit, np.split(np.array(rows), ENDS), np.split(team_rewards(steps, team), ENDS))


OTHERS = ("rd", "rrdu", "vib-rd", "lare-rrdu", "lare-signs", "lare-rd-shared", "llm-reward")


@pytest.mark.parametrize("method", ["lare-rd", "lare-linear", *map(long_case, OTHERS)])
def test_values_of_dead_agents_change_nothing(method):
    config, steps = MANY(method), random_steps(ONE_TEAM)
    dead, factors = ~steps.timestep.alive, random_factors(config, steps)
    changed = with_other_dead_values(steps)
    results = []
    for trajectory, z in ((steps, factors), (changed, np.where(dead[..., None], 99, factors).astype(np.float32))):
        learner = add_steps(untrained_learner(config), config, trajectory, z)
        reward = jitted(rewards, config)(stored_steps(learner), learner.decoders)
        assert not np.asarray(reward)[dead[:, 0]].any()
        update = update_once(learner, config) if config.method.uses_gradient else ()
        results.append((learner.decoders, reward, update, jitted(assess, config)(learner)))
    assert_close(*results)


TEAM_LEVEL = partial(MANY, credit_scope="state")
"""Credit to whole teams, by the global state."""


@pytest.mark.parametrize("method", ["rrdu", *map(long_case, ("rd", "rd-linear", "lare-rd", "llm-reward"))])
def test_team_level_rewards_are_the_same_for_all_alive_agents(method):
    config = TEAM_LEVEL(method, n_factors=(2,) if method[0] == "l" else ())
    learner, alive = learner_with_episodes(config), random_steps(ONE_TEAM).timestep.alive[:, 0]
    reward = np.asarray(jitted(rewards, config)(stored_steps(learner), learner.decoders))
    team_reward = reward.sum(axis=1) / np.maximum(alive.sum(axis=1), 1)
    np.testing.assert_allclose(reward, team_reward[:, None] * alive, rtol=1e-5, atol=1e-6)
    assert team_reward[alive.any(axis=1)].std() > 0
    if config.method.fit is not None:
        assert float(learner.decoders[0].statistics.n_rows) == TOTAL
        if config.method.uses_gradient:
            _, metrics = update_once(learner, config)
            assert np.isfinite(float(metrics["credit/loss"]))


def test_team_level_closed_form_and_assess():
    config, steps = TEAM_LEVEL("lare-linear", n_factors=(1,)), random_steps(ONE_TEAM)
    reward = team_rewards(steps, ONE_TEAM.teams[0]).astype(np.float32)
    factors = 0.5 + reward[:, None, None, None]
    learner = add_steps(untrained_learner(config), config, steps, factors)
    check_closed_form(learner.decoders[0], np.split(factors[:, 0, 0], ENDS), np.split(reward, ENDS))
    results = jitted(assess, config)(with_factor_decoders(learner, [1.0]))
    assert float(results["credit/error"]) == pytest.approx(0.5, rel=1e-4)
    assert float(results["credit/correlation"]) == pytest.approx(1, rel=1e-4)
