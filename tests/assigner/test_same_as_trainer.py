"""An assigner and the trainer compute the same rewards of the same steps."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from helpers.long_tests import long_case
from helpers.small_configs import (
    ONE_AGENT,
    ONE_TEAM,
    add_steps,
    jitted,
    random_steps,
    small_config,
    stored_steps,
    untrained_learner,
)
from helpers.toy_envs import toy_spec
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.credit.methods import METHODS
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule
from lare_rl.training.decoder_inputs import step_batch
from lare_rl.training.rewards import rewards

PHI_ENV = replace(ONE_AGENT, observation_size=2, action_size=1, low=ONE_AGENT.low[:, :1], high=ONE_AGENT.high[:, :1])
"""The sizes that `phi` is for. The bounds are -1 and 1, so that actions need no scaling."""


def learn(method, env, phi=None, payments=PAID_AT_END, exact="no", group=None, score="sum", n_running=2):
    """Return a learner and an assigner that have learned from the same steps. The last episode has `n_running` steps so far."""
    scored_observation = "after" if phi is None else toy_spec().scored_observation
    algorithm = "td3" if env.n_agents == 1 else "qmix"
    config = small_config(
        method, algorithm, env, capacity=1000, scored_observation=scored_observation, payments=payments
    )
    config = replace(config, credit=config.credit.model_copy(update={"exact": exact, "score": score}), group=group)
    credit = CreditAssigner(
        method,
        phi,
        task=None if phi is None else toy_spec(),
        observation_space=env.observation_size,
        action_space=env.action_size,
        settings=config.credit,
        payments=payments,
        groups=group is not None,
        **({} if env.n_agents == 1 else {"agents": env.n_agents, "max_steps": env.max_steps}),
    )
    learner = untrained_learner(config)
    # 12 chunks of 21 steps, and episodes of 9 to 12: other lengths of chunks, and of episodes up to 8, would be compiled too.
    steps = random_steps(env, lengths=(*(9, 12, 10, 11, 12) * 4, 12, 12, 12 - n_running, n_running + 1))
    steps = jax.tree.map(lambda leaf: leaf[:-1], steps)
    episode = np.cumsum(steps.ended[:, 0]) - steps.ended[:, 0]
    level = np.where(episode % 3 == 0, 0, 1)  # in the order in which an assigner counts its groups
    if group is not None:
        measures = {group: np.where(steps.ended, level[:, None], 0).astype(np.float32)}  # known at the last step alone
        reward = steps.next_timestep.reward + 3 * level[:, None, None].astype(np.float32)
        steps = steps._replace(next_timestep=steps.next_timestep._replace(measures=measures, reward=reward))
    agent = 0 if env.n_agents == 1 else slice(None)
    for rows in np.array_split(np.arange(len(steps.ended)), 12):
        chunk = jax.tree.map(lambda leaf, rows=rows: leaf[rows], steps)
        observation, action, next_observation, reward = (
            values[:, 0, agent]
            for values in (
                chunk.timestep.observation,
                chunk.env_action,
                chunk.next_timestep.observation,
                chunk.next_timestep.reward,
            )
        )
        factors = None
        if phi is not None:
            factors = phi.step_factors(observation, action, next_observation, scored_observation)[:, None, None]
        learner = add_steps(learner, config, chunk, factors, learn=True)
        alive = chunk.timestep.alive[:, 0] if env.n_agents > 1 else None
        never = np.zeros(len(rows), bool)
        ended, env_ids = chunk.ended[:, 0], [0] * len(rows)
        groups = None if group is None else [f"level {k}" for k in level[rows]]
        credit.add(
            *(observation, action, next_observation, reward, never, ended), env_ids=env_ids, alive=alive, group=groups
        )
        credit.rewards_at([])  # the trainer learns after each chunk
    return learner, config, credit


EVERY_5, WINDOW = PaymentRule(period=5), PaymentRule(period=4, window=6)


@pytest.mark.parametrize(
    ("method", "env", "changes"),
    [
        long_case(
            "lare-bayes-history", PHI_ENV, {"score": "auto", "payments": EVERY_5, "exact": "spread", "n_running": 4}
        ),
        long_case("bayes-progress", replace(ONE_TEAM, agents_leave=False), {"exact": "spread"}),
        long_case("bayes-progress", ONE_AGENT, {"exact": "last", "n_running": 11}),
        long_case("bayes", ONE_AGENT, {"score": "binary", "group": "map"}),
        long_case("rd-linear", ONE_AGENT, {"group": "map", "score": "auto"}),
        long_case("rd-linear", ONE_AGENT, {"payments": WINDOW, "exact": "last", "score": "average"}),
    ],
)
def test_rewards_and_lengths_agree(method, env, changes, phi):
    """Also those of a running episode, which may be longer than most."""
    learner, config, credit = learn(method, env, phi if METHODS[method].needs_phi else None, **changes)
    steps = stored_steps(learner)
    n_running = changes.get("n_running", 2)
    n_unpaid = n_running % 5 if "payments" in changes else n_running
    assert (~steps.episode_ended).sum() == n_unpaid
    lengths = credit.store.lengths(np.arange(credit.store.n_added))
    np.testing.assert_array_equal(lengths, np.asarray(step_batch(steps, config, 0).length).ravel())
    expected = np.asarray(jitted(rewards, config)(steps, learner.decoders))
    expected = expected if env.n_agents > 1 else expected[..., 0]
    r_hat = credit.rewards_at(np.arange(credit.store.n_added))
    rtol = 1e-3 if changes.get("score") == "binary" else 1e-4
    np.testing.assert_allclose(r_hat, expected, rtol=rtol, atol=0.1 * rtol * np.abs(expected).max())
    assert np.abs(expected).max() > 0
    if config.method.fit is None:
        return
    assert credit.learner.n_learned == int(learner.n_learned.sum())
    fits = learner.decoders[0].closed_form, credit.learner.decoder.closed_form
    if fits[0].log_odds is not None:
        trained, assigned = (fit.log_odds for fit in fits)
        assert trained.n_episodes == assigned.n_episodes
        np.testing.assert_allclose(trained.posterior.weight, assigned.posterior.weight, rtol=1e-3, atol=1e-4)
        assert np.abs(assigned.posterior.weight).max() > 0
    elif "group" in changes:
        intercept = np.asarray(fits[0].intercept)[0]
        assert intercept[1] - intercept[0] > 1.0
        assert not intercept[2:].any()
