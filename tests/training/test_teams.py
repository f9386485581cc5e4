"""The compiled parts of training many agents: what each method reads and is rewarded with."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare.algorithms.ppo import PPOSettings
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import METHODS, Encoder
from lare.tasks.particles.table import find_particle_task
from lare.tasks.particles.task import ACTIONS, STEPS
from lare.training import teams
from lare.training.settings import AgentSettings
from lare.training.teams import Recipe

COUNT = 4


def recipe(method, task="TriangleArea", **changes):
    latent = METHODS[method].encoder is Encoder.LATENT
    values = {
        "task": find_particle_task(task),
        "method": METHODS[method],
        "ppo": PPOSettings(hidden=(8,), minibatch=100, epochs=1),
        "agents": AgentSettings(
            episodes=COUNT, fit_updates=2, capacity=6, credit=CreditSettings(hidden=(8,), steps=50, drawn_steps=5)
        ),
        "factors": {"TriangleArea": (2,), "CompetitivePP-6": (3, 2)}[task] if latent else (),
    }
    return Recipe(**(values | changes))


def played_by(chosen):
    learner = teams.init(jax.random.key(0), chosen)
    play = jax.jit(partial(teams.play, count=COUNT, recipe=chosen))
    return learner, play(learner.algorithm.online.actor, jax.random.key(1))


def factors_for(chosen, played):
    size = max(chosen.factors, default=0)
    rows = np.random.default_rng(0).normal(size=(*played.reward.shape, size)).astype(np.float32)
    return jnp.asarray(rows)


def test_episodes_are_whole_and_follow_each_other():
    chosen = recipe("dense")
    _, played = played_by(chosen)
    assert played.observation.shape == (STEPS, COUNT, 3, 14)
    np.testing.assert_array_equal(played.observation[1:], played.next_observation[:-1])
    np.testing.assert_array_equal(played.action.sum(axis=-1), 1)
    assert played.action.shape[-1] == ACTIONS
    assert not np.array_equal(played.observation[0, 0], played.observation[0, 1])


def test_policies_of_several_teams_know_who_they_act_for():
    one, many = recipe("dense"), recipe("dense", "CompetitivePP-6")
    assert (one.policy_input, many.policy_input) == (14, 24 + 8)
    rows = jnp.zeros((2, 8, 24))
    np.testing.assert_array_equal(teams.seen(rows, many)[..., 24:], np.broadcast_to(np.eye(8), (2, 8, 8)))


def test_each_team_has_a_decoder_and_a_return_of_its_own():
    chosen = recipe("lare-rd", "CompetitivePP-6")
    learner, played = played_by(chosen)
    factors = factors_for(chosen, played)
    learner = teams.store(learner, played, factors, chosen)
    assert [credit.moments.mean.shape for credit in learner.credit] == [(3,), (2,)]
    reward = np.asarray(played.reward)
    for credit, team in zip(learner.credit, chosen.task.teams, strict=True):
        means = reward[..., team.start : team.stop].mean(axis=(0, 2))
        assert float(credit.scale.mean_square) == pytest.approx(float((means**2).mean()), rel=1e-4)
    fitted, _ = jax.jit(partial(teams.fit, recipe=chosen))(learner, jax.random.key(0))
    for before, after in zip(learner.credit, fitted, strict=True):
        assert not jax.tree.all(jax.tree.map(jnp.array_equal, before.decoder, after.decoder))


def test_rewards():
    for method in ("dense", "episodic"):
        chosen = recipe(method, "CompetitivePP-6")
        learner, played = played_by(chosen)
        true = jnp.swapaxes(played.reward, 0, 1)
        got = teams.rewards(learner, jnp.zeros((COUNT, STEPS, 8, 0)), true, chosen)
        if method == "dense":
            np.testing.assert_array_equal(got, true)
            continue
        assert not got[:, :-1].any()
        for team in chosen.task.teams:
            total = np.asarray(true)[..., team.start : team.stop].sum(axis=1).mean(axis=1)
            given = got[:, -1, team.start : team.stop]
            np.testing.assert_allclose(given, np.broadcast_to(total[:, None], given.shape), rtol=1e-4, atol=1e-6)


def test_shared_credit_is_the_mean_over_the_agents():
    chosen, shared = recipe("lare-rd"), recipe("lare-rd-shared")
    learner, played = played_by(chosen)
    learner = teams.store(learner, played, factors_for(chosen, played), chosen)
    rows, true = jnp.swapaxes(factors_for(chosen, played), 0, 1), jnp.swapaxes(played.reward, 0, 1)
    own, same = (teams.rewards(learner, rows, true, which) for which in (chosen, shared))
    np.testing.assert_allclose(same, np.broadcast_to(own.mean(axis=-1, keepdims=True), own.shape), rtol=1e-5)
    assert np.asarray(own).std(axis=-1).min() > 0


def test_seeds_in_lockstep_are_seeds_alone():
    chosen = recipe("lare-rd")
    functions = teams.compiled(chosen)
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    start = jax.vmap(partial(teams.init, recipe=chosen))(keys)
    played = functions.play(start.algorithm.online.actor, keys, COUNT)
    one = jax.tree.map(lambda leaf: leaf[1], start)
    alone = jax.jit(partial(teams.play, count=COUNT, recipe=chosen))(one.algorithm.online.actor, keys[1])
    for a, b in zip(jax.tree.leaves(played), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(a[1], b, rtol=1e-4, atol=1e-4)
