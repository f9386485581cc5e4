"""Rollouts of runs whose agents leave, and whose episodes are paid several times."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lare_rl
from helpers.jax_toy_envs import Echo, echo_spec
from helpers.numpy_twins import assert_close
from helpers.small_configs import SMALL_SETTINGS, add_steps, random_steps
from helpers.untrained_runs import untrained_run
from lare_rl.errors import LareError
from lare_rl.evaluation import played_episodes as module
from lare_rl.evaluation.played_episodes import compute_proxy_rewards, play_run, sample_steps, unroll_policy
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed

pytestmark = pytest.mark.long

TASK = echo_spec(environment="hosted/three", credit_scope="state", observation_size=9, action_size=9, payments=2)
N_EPISODES = 12


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run before its first step: nothing of its training is compiled."""
    settings = lare_rl.Settings(
        method="rd-linear",
        algorithm="ippo",
        steps=120,
        rollout_steps=60,
        environments=2,
        evaluate_every=120,
        credit={"exact": "last", "score": "sum"},
        ippo={"hidden": (8,), "minibatch_size": 60, "epochs": 1},
    )
    return untrained_run(TASK, settings, tmp_path_factory.mktemp("runs") / "echo")


@pytest.fixture(autouse=True, scope="module")
def no_rewards():
    """Leave out the training rewards, which take seconds to compile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "compute_proxy_rewards", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def played(run):
    return play_run(run, N_EPISODES)


class Broken(Echo):
    """It shows and pays NaN after the end of an episode, and its state holds a random key."""

    def reset(self, key):
        state, timestep = super().reset(key)
        return (state, key), timestep

    def step(self, state, action, key):
        next_state, timestep = super().step(state[0], action, key)
        ended = state[0].step >= state[0].length
        values = {
            name: jnp.where(ended, jnp.nan, getattr(timestep, name)) for name in ("observation", "state", "reward")
        }
        return (next_state, key), timestep._replace(**values)


def test_steps_after_an_end_are_not_seen(run):
    state = load_learner(run)
    batch = unroll_policy(Broken(), state.config, jax.tree.map(lambda leaf: leaf[:1], state.actor), N_EPISODES, 0)
    assert len({int(n) for n in batch.mask.sum(axis=0)}) > 1
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(batch.steps))


def test_actor_is_that_of_the_checkpoint(tmp_path, monkeypatch):
    """A run of QMIX that was stopped before its first step explores in every step."""
    settings = lare_rl.Settings(
        method="ircr", algorithm="qmix", steps=120, rollout_steps=60, environments=2, qmix=SMALL_SETTINGS["qmix"]
    )
    run = untrained_run(TASK, settings, tmp_path / "qmix")

    def unroll(run, config, actor, n_episodes):
        raise LareError(f"epsilon {float(actor.epsilon[0])}")

    monkeypatch.setattr(module, "_unroll_on_host", unroll)
    with pytest.raises(LareError, match=r"epsilon 1\.0"):
        play_run(run)


def test_exact_rewards_add_up_to_payments(run, played):
    state = load_learner(run)
    steps = random_steps(state.config.env, envs=2, lengths=(6, 4, 5, 6, 3, 6))
    learner = add_steps(select_seed(state.learner), state.config, steps)
    rewards = compute_proxy_rewards(learner, played.steps, played.factors, state.config)
    sums, payments = [], []
    for episode in range(N_EPISODES):
        values = np.asarray(played.steps.timestep.alive), played.reward, rewards
        alive, true, training = (played.select_episode(x, episode) for x in values)
        for total, rewards_ in ((sums, training), (payments, true)):
            team_reward = (rewards_ * alive).sum(axis=1) / alive.sum(axis=1)
            total += [team_reward[start : start + 2].sum() for start in range(0, len(true), 2)]
    assert np.std(payments) > 0.1
    np.testing.assert_allclose(sums, payments, atol=1e-4)


def test_sampled_reward_of_a_team_is_the_mean_over_agents_that_are_alive(run, played, monkeypatch):
    monkeypatch.setattr(module, "N_SAMPLE_EPISODES", N_EPISODES)
    (sample,) = sample_steps(run)
    alive = np.asarray(played.steps.timestep.alive)
    expected = (played.reward * alive).sum(axis=-1) / alive.sum(axis=-1)
    assert not alive[played.mask].all()
    np.testing.assert_allclose(sample.reward.ravel(), expected[played.mask], rtol=1e-6)
    assert sample.has_step_rewards
    assert np.isnan(replace(sample, has_step_rewards=False).correlations).all()


def test_payments_for_several_steps_are_no_step_rewards(run, played, monkeypatch):
    is_paid = np.arange(len(played.mask))[:, None, None] % 2 == 1  # every second step, as in the task
    timestep = played.steps.next_timestep._replace(reward=np.where(is_paid, played.reward, 0))
    bagged = replace(played, steps=played.steps._replace(next_timestep=timestep))
    monkeypatch.setattr(module, "play_run", lambda *arguments, **options: bagged)
    (sample,) = sample_steps(run)
    assert not sample.has_step_rewards


def test_an_episode_does_not_depend_on_the_number_of_environments(run, played, monkeypatch):
    """Environments in processes of their own are few, and play some episodes after others."""
    monkeypatch.setattr(module, "n_open_envs", lambda task, n_seeds, n_episodes: 5)
    few = play_run(run, N_EPISODES)
    assert len({int(mask.sum()) for mask in played.mask.T}) > 1
    for episode in range(N_EPISODES):
        assert_close(*(batch.select_episode(batch.steps, episode) for batch in (played, few)))
