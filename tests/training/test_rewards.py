"""Training rewards of stored steps, and their accuracy."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.small_configs import (
    LENGTHS,
    TWO_TEAMS,
    add_steps,
    jitted,
    random_steps,
    small_config,
    stored_steps,
    untrained_learner,
)
from lare_rl.envs.interface import team_mean
from lare_rl.training import on_policy
from lare_rl.training.rewards import accuracy_metrics, masked_correlation, rewards


@pytest.mark.long
def test_exact_rewards_of_teams_add_up_to_returns():
    """For rollouts, the sums of proxy rewards are computed with each update."""
    config = small_config("rd", "ippo", TWO_TEAMS, capacity=1000, rollout_steps=sum(LENGTHS))
    config = replace(config, credit=config.credit.model_copy(update={"exact": "spread"}))
    learner = add_steps(untrained_learner(config), config, random_steps(TWO_TEAMS))
    steps = stored_steps(jitted(on_policy._predict_newest_returns, config)(learner))
    r_hat, alive = np.asarray(rewards(steps, learner.decoders, config), np.float64), np.asarray(steps.columns["alive"])
    last, returns = np.asarray(steps.last), np.asarray(steps.episodic_reward)
    starts = np.append(0, np.flatnonzero(last)[:-1] + 1)
    for i, team in enumerate(TWO_TEAMS.teams):
        # Nothing can be added at a step without agents.
        complete = np.logical_and.reduceat(alive[:, team.agents].any(axis=1), starts)
        sums = np.add.reduceat(team_mean(r_hat, alive, team), starts)
        assert complete.any()
        np.testing.assert_allclose(sums[complete], returns[last, i][complete], rtol=1e-4, atol=1e-5)


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
