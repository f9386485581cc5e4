"""Training rewards of stored steps: with `exact`, they add up to the return of each episode, or to each payment."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.small_configs import (
    LENGTHS,
    ONE_AGENT,
    TWO_TEAMS,
    add_steps,
    jitted,
    random_steps,
    small_config,
    stored_steps,
    untrained_learner,
)
from lare_rl.data import replay
from lare_rl.envs.interface import team_mean
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule
from lare_rl.training import on_policy
from lare_rl.training.rewards import accuracy_metrics, masked_correlation, rewards


def exact_config(method, algorithm, env, exact, payments):
    config = small_config(method, algorithm, env, capacity=1000, payments=payments, rollout_steps=sum(LENGTHS))
    return replace(config, credit=config.credit.model_copy(update={"exact": exact}))


def sums_of_payments(values, last):
    """Return the sum of the values up to each step that is paid, since the one before."""
    ends = np.flatnonzero(last) + 1
    return np.add.reduceat(values[: ends[-1]], np.append(0, ends[:-1]))


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "algorithm", "env", "exact", "payments"),
    [
        ("rd-linear", "td3", ONE_AGENT, "last", PaymentRule(period=4)),
        ("rd", "ippo", TWO_TEAMS, "spread", PAID_AT_END),
        ("rd-linear", "td3", ONE_AGENT, "spread", PaymentRule(period=4)),
        ("rd-linear", "ippo", TWO_TEAMS, "last", PaymentRule(nonzero=True)),
        ("rd", "ppo", ONE_AGENT, "last", PaymentRule(period=3)),
    ],
)
def test_exact_rewards_add_up_to_payments(method, algorithm, env, exact, payments):
    config = exact_config(method, algorithm, env, exact, payments)
    learner = untrained_learner(config)
    for seed in range(3):
        learner = add_steps(learner, config, random_steps(env, seed=seed))
    steps = stored_steps(learner)
    if algorithm != "td3":  # the sums are computed with each update
        learner = jitted(on_policy._predict_newest_returns, config)(learner)
        index = replay.newest_steps(learner.replay, config.rollout_steps)
        steps = jax.tree.map(lambda rows: rows[0], replay.read(learner.replay, index))
    r_hat, inexact = (
        np.asarray(rewards(values, learner.decoders, config), np.float64)
        for values in (steps, steps._replace(residual=None))
    )
    alive = np.asarray(steps.columns.get("alive", np.ones((len(r_hat), env.n_agents), bool)))
    last, payment = np.asarray(steps.last), np.asarray(steps.episodic_reward)
    for i, team in enumerate(env.teams):
        team_reward = team_mean(r_hat, alive, team)
        has_agents = np.asarray(alive[:, team.agents].any(axis=1))
        # Nothing can be added at a step without agents.
        complete = has_agents[last] if exact == "last" else sums_of_payments(~has_agents, last) == 0
        sums, expected = sums_of_payments(team_reward, last)[complete], payment[last, i][complete]
        assert len(sums) > 2
        np.testing.assert_allclose(sums, expected, rtol=1e-4, atol=1e-5)
        assert np.abs(sums_of_payments(team_mean(inexact, alive, team), last) - payment[last, i]).max() > 0.1
    if exact == "last":
        np.testing.assert_array_equal(r_hat[~last], inexact[~last])


@pytest.mark.long
def test_rewards_of_episodes_that_are_not_learned_yet_are_not_corrected():
    config = exact_config("rd-linear", "td3", ONE_AGENT, "last", PaymentRule(period=4))  # compiled as above
    learner = add_steps(untrained_learner(config), config, random_steps())
    learner = add_steps(learner, config, random_steps(seed=1), learn=False)
    residual = np.asarray(stored_steps(learner).residual)[:, 0]
    assert (residual[: sum(LENGTHS)] != 0).all()
    assert (residual[sum(LENGTHS) :] == 0).all()


def test_metrics_against_numpy():
    rng = np.random.default_rng(0)
    reward, noise = rng.normal(size=(2, 50)).astype(np.float32)
    r_hat, mask, last = 2 * reward + noise, np.arange(50) < 40, np.arange(50) % 10 == 9
    args = [jnp.asarray(values) for values in (r_hat, reward, last, mask)]
    metrics = accuracy_metrics(*args, calibrated=True)
    assert float(metrics["credit/error"]) == pytest.approx(np.abs(r_hat - reward)[:40].mean(), rel=1e-5)
    want = np.corrcoef(r_hat[:40], reward[:40])[0, 1]
    assert float(metrics["credit/correlation"]) == pytest.approx(want, rel=1e-4)
    assert list(accuracy_metrics(*args, calibrated=False)) == ["credit/correlation"]
    only_last = accuracy_metrics(args[0], args[1] * args[2], *args[2:], calibrated=True)
    assert np.isnan(list(only_last.values())).all()
    for constant in (1.0, 0.1):  # the mean of the second one is rounded
        assert np.isnan(float(masked_correlation(args[0], jnp.full(50, constant), args[3])))
