"""The compiled parts of training many agents: what each method reads and is rewarded with."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare.algorithms.ppo import PPOSettings
from lare.credit.closed_form import LinearDecoder
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
        "ppo": PPOSettings(hidden=(8,), minibatch_size=100, epochs=1),
        "agents": AgentSettings(
            episodes=COUNT, fit_updates=2, capacity=6, credit=CreditSettings(hidden=(8,), steps=50, drawn_steps=5)
        ),
        "factors": {"TriangleArea": (2,), "CompetitivePP-6": (3, 2)}.get(task, ()) if latent else (),
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


@pytest.mark.parametrize("method", ["rd", "stas", "lare-rd"])
def test_what_decoders_see(method):
    """RD and AREL what each agent met after the step, STAS what it met before it and did, LaRe the factors."""
    chosen = recipe(method)
    _, played = played_by(chosen)
    z = factors_for(chosen, played)
    want = {
        "rd": played.next_observation,
        "stas": np.concatenate([played.observation, played.action], axis=-1),
        "lare-rd": z,
    }[method]
    np.testing.assert_array_equal(teams.features(played, z, chosen), np.swapaxes(want, 0, 1))


def test_a_closed_form_takes_the_mean_over_steps_and_agents():
    chosen = recipe("lare-linear", "CompetitivePP-6")
    learner, played = played_by(chosen)
    z = factors_for(chosen, played)
    learner = teams.store(learner, played, z, chosen)
    for credit, team, size in zip(learner.credit, chosen.task.teams, chosen.factors, strict=True):
        rows = np.asarray(z)[..., team.start : team.stop, :size].mean(axis=(0, 2))
        paid = np.asarray(played.reward)[..., team.start : team.stop].mean(axis=(0, 2))
        v = np.concatenate([rows, paid[:, None]], axis=1)
        np.testing.assert_allclose(credit.totals.mean, v.mean(axis=0), rtol=1e-4, atol=1e-6)
        centred = v - v.mean(axis=0)
        np.testing.assert_allclose(credit.totals.products, centred.T @ centred, rtol=1e-3, atol=1e-5)


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


@pytest.fixture
def numbered():
    """Two teams whose decoders say the number that stands in their only factor, the second one with a minus."""
    chosen = recipe("lare-linear", "CompetitivePP-6", factors=(1, 1))
    learner, played = played_by(chosen)
    numbers = jnp.arange(played.reward.size, dtype=jnp.float32).reshape(played.reward.shape)
    credit = tuple(
        one._replace(decoder=LinearDecoder(jnp.array([sign]), jnp.zeros(())))
        for one, sign in zip(learner.credit, (1.0, -1.0), strict=True)
    )
    own = np.asarray(numbers) * np.repeat([1.0, -1.0], [6, 2])
    return chosen, learner._replace(credit=credit), played, numbers[..., None], own


def test_every_agent_has_the_proxy_rewards_of_its_own_steps(numbered):
    chosen, learner, played, numbers, own = numbered
    rows, true = jnp.swapaxes(numbers, 0, 1), jnp.swapaxes(played.reward, 0, 1)
    np.testing.assert_array_equal(teams.rewards(learner, rows, true, chosen), np.swapaxes(own, 0, 1))


def test_the_policy_is_improved_on_what_each_agent_saw_did_and_was_paid(numbered, monkeypatch):
    chosen, learner, played, numbers, own = numbered
    rollouts = []

    def update(algorithm, rollout, key, left, settings):
        rollouts.append(rollout)
        return algorithm, {}

    monkeypatch.setattr(teams.ppo, "update", update)
    teams.improve(learner, played, numbers, jax.random.key(0), jnp.array(1.0), chosen)
    before, after = (np.asarray(teams.seen(rows, chosen)) for rows in (played.observation, played.next_observation))
    for step, episode, agent in np.ndindex(STEPS, COUNT, 8):
        lane, place = episode * 8 + agent, (step, episode, agent)
        assert float(rollouts[0].reward[step, lane]) == own[place]
        np.testing.assert_array_equal(rollouts[0].observation[step, lane], before[place])
        np.testing.assert_array_equal(rollouts[0].action[step, lane], played.action[place])
        np.testing.assert_array_equal(rollouts[0].next_observation[step, lane], after[place])
    ended = np.zeros((STEPS, COUNT * 8))
    ended[-1] = 1
    np.testing.assert_array_equal(rollouts[0].ended, ended)
    np.testing.assert_array_equal(rollouts[0].continues, 1 - ended)


def test_every_team_is_measured_by_itself(numbered):
    """Decoders that say the true reward, and its negative."""
    chosen, learner, played, _, _ = numbered
    stored = teams.store(learner, played, played.reward[..., None], chosen)
    found = teams.assess(stored._replace(credit=learner.credit), chosen)
    assert {name: round(float(value), 3) for name, value in found.items() if "correlation" in name} == {
        "credit/correlation": 1,
        "credit/correlation_predator": 1,
        "credit/correlation_prey": -1,
    }
    assert float(found["credit/error"]) == float(found["credit/error_predator"]) == pytest.approx(0, abs=1e-6)
    assert float(found["credit/error_prey"]) == pytest.approx(2 * np.abs(played.reward[..., 6:]).mean(), rel=1e-4)


def test_uniform_rewards_lie_between_the_worst_and_the_best_episode():
    chosen = recipe("ircr")
    learner, played = played_by(chosen)
    learner = teams.store(learner, played, factors_for(chosen, played), chosen)
    true = jnp.swapaxes(played.reward, 0, 1)
    got = np.asarray(teams.rewards(learner, jnp.zeros((COUNT, STEPS, 3, 0)), true, chosen))
    means = np.asarray(true).mean(axis=(1, 2))
    want = (means - means.min()) / (means.max() - means.min())
    np.testing.assert_allclose(got, np.broadcast_to(want[:, None, None], got.shape), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("method", ["lare-rd", "lare-rrdu"])
def test_must_learn_who_earned_what_from_what_was_played(method):
    """Of two factors one is the true reward of the agent; the decoder is told the mean over agents and steps."""
    credit = CreditSettings(hidden=(16,), learning_rate=1e-2, steps=500, drawn_steps=10)
    agents = AgentSettings(episodes=COUNT, fit_updates=400, capacity=64, credit=credit)
    chosen = recipe(method, "PP-6", agents=agents, factors=(2,))
    learner = teams.init(jax.random.key(0), chosen)
    play = jax.jit(partial(teams.play, count=64, recipe=chosen))
    played = play(learner.algorithm.online.actor, jax.random.key(1))
    noise = np.random.default_rng(0).normal(size=played.reward.shape).astype(np.float32)
    learner = teams.store(learner, played, jnp.stack([played.reward, noise], axis=-1), chosen)
    fitted, _ = jax.jit(partial(teams.fit, recipe=chosen))(learner, jax.random.key(2))
    found = teams.assess(learner._replace(credit=fitted), chosen)
    assert float(found["credit/correlation"]) > 0.95
    assert float(found["credit/error"]) < 0.1  # untrained, it is 0.7


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
