"""What each method reads and is rewarded with: of one agent, of many, of teams, and of those who are still there."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.recipes import (
    ALONE,
    LENGTHS,
    RIVALS,
    TOGETHER,
    TOTAL,
    config_of,
    every_step,
    factors_for,
    jitted,
    paid_by,
    read,
    steps_of,
    stored,
    untrained,
    with_steps,
)
from helpers.tiers import long
from lare_rl.credit import closed_form, returns
from lare_rl.credit.basis import Basis
from lare_rl.credit.closed_form import LinearDecoder
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import TABLE, Fit, Reward
from lare_rl.data import replay
from lare_rl.data.sampling import sample_parts
from lare_rl.envs.interface import EnvSpec, Team
from lare_rl.nn.normalise import magnitude
from lare_rl.training import learner as common

ENDS = np.cumsum(LENGTHS)[:-1]
MANY = partial(config_of, algorithm="ippo", env=TOGETHER)
TEAMS = partial(config_of, algorithm="ippo", env=RIVALS)


def close(one, other, rtol=1e-4, atol=1e-5):
    jax.tree.map(partial(np.testing.assert_allclose, rtol=rtol, atol=atol), one, other)


def proxy_rewards(steps, paid, config):
    return common.proxy_rewards(steps, paid, config, 0)


def fitted(learner, config, key=0):
    """One update of the decoders on what is drawn by a key, and what it measured."""
    draw = common.sample_credit(learner.replay, jax.random.key(key), 1, config)
    draw = jax.tree.map(lambda leaf: leaf[0], draw)
    return jitted(common.fit, config)(learner.credit, learner.replay, draw, jax.random.key(1))


# A single agent.


def test_store_keeps_statistics_of_what_came():
    config = config_of("lare-rrdu")
    learner, steps = stored(config), steps_of()
    factors = factors_for(config, steps)
    np.testing.assert_allclose(learner.credit[0].statistics.mean, factors.mean(axis=(0, 1, 2)), rtol=1e-4)
    assert float(learner.credit[0].statistics.rows) == TOTAL
    means = [part.mean() for part in np.split(steps.after.reward.ravel(), ENDS)]
    assert float(learner.scale[0].mean_square) == pytest.approx(np.mean(np.square(means)), rel=1e-4)
    np.testing.assert_array_equal(learner.scale[0], learner.credit[0].scale)


def test_raw_features_are_s_a_and_the_change():
    config = config_of("rrdu")
    drawn = every_step(stored(config))
    s, a, n = drawn.before["observation"], drawn.before["action"], drawn.after["observation"]
    taken = np.clip(a, -1, 1)
    assert (taken != a).any()
    want = np.concatenate([s, taken, s - n], axis=-1)
    np.testing.assert_array_equal(common.features(drawn, config, 0), want)
    assert want.shape[-1] == config.bases[0].inputs == 8


def test_state_and_action_alone():
    config = config_of("diaster")
    drawn = every_step(stored(config))
    want = np.concatenate([drawn.before["observation"], np.clip(drawn.before["action"], -1, 1)], axis=-1)
    np.testing.assert_array_equal(common.features(drawn, config, 0), want)
    assert want.shape[-1] == config.bases[0].inputs == 5


@pytest.mark.parametrize("judges", ["before", long("after"), "both"])
@pytest.mark.parametrize("method", [long("rd-linear"), "bayes", long("lare-linear"), "lare-bayes"])
def test_closed_forms_see_the_factors_and_the_states_that_the_task_judges(method, judges):
    config, steps = config_of(method, judges=judges), steps_of()
    drawn = every_step(stored(config))
    states = {"before": [drawn.before], "after": [drawn.after], "both": [drawn.before, drawn.after]}[judges]
    want = [factors_for(config, steps)[:, 0]] if "lare" in method else []
    if method != "lare-linear":
        want += [*(state["observation"] for state in states), np.clip(drawn.before["action"], -1, 1)]
    want = np.concatenate(want, axis=-1)
    np.testing.assert_array_equal(common.features(drawn, config, 0), want)
    assert want.shape[-1] == config.bases[0].inputs
    assert config.bases[0].extended == (method in ("bayes", "lare-bayes"))


@pytest.mark.parametrize("drawn", [4, 10])
def test_the_unbiased_loss_has_the_expectation_of_the_full_one_for_episodes_of_any_length(drawn):
    """Lengths from 3 to 12: with K = 10, three of the five episodes are shorter. RRD's loss is larger."""
    losses = {}
    for name in ("rrd", "rrdu"):
        config = config_of(name)
        learner = stored(config)
        steep = jax.tree.map(lambda weight: 6 * weight, learner.credit[0].decoder)  # steps that differ
        learner = learner._replace(credit=(learner.credit[0]._replace(decoder=steep),))
        draws = sample_parts(learner.replay, jax.random.key(3), 1, 40_000, drawn)
        first = jax.tree.map(lambda leaf: leaf[0], draws)
        _, measured = jitted(common.fit, config)(learner.credit, learner.replay, first, jax.random.key(0))
        losses[name] = float(measured["credit/loss"])
    every, unit = every_step(learner), float(magnitude(learner.credit[0].scale))
    r_hat = np.asarray(jitted(proxy_rewards, config)(every, paid_by(learner)))[:, 0] / unit
    r = np.asarray(every.before["reward"])[:, 0] / unit
    errors = [(a.mean() - b.mean()) ** 2 for a, b in zip(np.split(r_hat, ENDS), np.split(r, ENDS), strict=True)]
    chosen = np.bincount(np.searchsorted(ENDS, draws.episodes.first.number[0], side="right"), minlength=5) / 40_000
    want = float(chosen @ errors)
    assert losses["rrdu"] == pytest.approx(want, rel=0.02)
    assert losses["rrd"] > 1.025 * want


@pytest.mark.parametrize("method", ["rd", long("rrd"), "rrdu", long("vib-rd"), long("vib-rrdu")])
def test_padding_counts_for_nothing(method):
    config = config_of(method)
    learner = stored(config)
    draws = jax.tree.map(lambda one: one[0], common.sample_credit(learner.replay, jax.random.key(2), 1, config))
    padding = np.asarray(draws.episode) >= len(draws.episodes.length)
    assert padding.any()
    elsewhere = draws._replace(steps=draws.steps._replace(number=jnp.where(padding, 40, draws.steps.number)))
    assert (np.asarray(draws.steps.number) != elsewhere.steps.number).any()
    one, other = (
        jitted(common.fit, config)(learner.credit, learner.replay, each, jax.random.key(0))
        for each in (draws, elsewhere)
    )
    close(one, other, 1e-5, 1e-7)


@pytest.mark.parametrize("method", ["dense", "episodic", "lare-rrdu", "ircr", "llm-reward"])
@pytest.mark.parametrize("scale_rewards", [False, True])
def test_rewards(method, scale_rewards):
    config = config_of(method, scale_rewards=scale_rewards)
    learner, steps = stored(config), steps_of()
    got, unit = jitted(common.rewards, config)(every_step(learner), paid_by(learner)), magnitude(learner.scale[0])
    assert got.shape == (TOTAL, 1)
    got = np.asarray(got)[:, 0] * (unit if scale_rewards else 1)
    true, ended = steps.after.reward.ravel(), steps.ended.ravel()
    match config.method.reward:
        case Reward.TRUE:
            np.testing.assert_allclose(got, true, rtol=1e-5)
        case Reward.EPISODIC:
            returns = [part.sum() for part in np.split(true, ENDS)]
            np.testing.assert_allclose(got[ended], returns, rtol=1e-4, atol=1e-6)
            assert not got[~ended].any()
        case Reward.DESIGNED:
            np.testing.assert_allclose(got, factors_for(config, steps)[:, 0, 0, 0], rtol=1e-5)
        case Reward.UNIFORM:
            means = np.array([part.mean() for part in np.split(true, ENDS)])
            want = np.repeat((means - means.min()) / (means.max() - means.min()), LENGTHS)
            np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)
        case Reward.PROXY:
            assert got.std() > 0


def begun(config):
    """With an episode of two steps that goes on, and a learner without."""
    learner, steps = stored(config), jax.tree.map(lambda rows: rows[:2], steps_of())
    return with_steps(learner, config, steps), learner


def test_an_episode_under_way_is_worth_half_as_much_as_the_best():
    config = config_of("ircr")
    learner, _ = begun(config)
    got = jitted(common.rewards, config)(every_step(learner), paid_by(learner))[:, 0]
    np.testing.assert_array_equal(got[-2:], [0.5, 0.5])
    assert float(got[0]) != 0.5


def check_closed_form(credit, z, reward):
    """Sums over episodes, weighted by their steps, of standardised factors, of R/T and of R; in NumPy. NaN: nobody was there."""
    decoder = credit.closed.decoder
    standard = [np.nan_to_num((one - np.asarray(decoder.mean)) / np.asarray(decoder.deviation)) for one in z]
    v = [[*one.mean(axis=0), paid.mean(), paid.sum()] for one, paid in zip(standard, reward, strict=True)]
    length = np.array([len(one) for one in z])
    centred = np.array(v) - np.average(v, axis=0, weights=length)
    with jax.enable_x64(True):
        sums = closed_form.whole(credit.closed.summed)
    assert (float(sums.episodes), float(sums.steps)) == (len(z), length.sum())
    np.testing.assert_allclose(sums.mean, np.average(v, axis=0, weights=length), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(sums.products, (length * centred.T) @ centred, rtol=1e-3, atol=1e-4)


def test_closed_forms_sum_over_the_episodes_that_have_ended():
    config = config_of("lare-linear")
    factors, steps = factors_for(config, steps_of()), steps_of()
    learner, _ = begun(config)
    check_closed_form(learner.credit[0], np.split(factors[:, 0, 0], ENDS), np.split(steps.after.reward[:, 0, 0], ENDS))


@pytest.mark.parametrize("method", ["lare-linear", "rd-linear"])
def test_forgetting_the_episode_under_way_leaves_the_fit(method):
    config = config_of(method)
    longer, learner = begun(config)
    back = common.forget_episodes(longer, jnp.array([True]))
    jax.tree.map(np.testing.assert_array_equal, back.credit[0].closed, learner.credit[0].closed)
    assert back.replay.transitions.tolist() == learner.replay.transitions.tolist()


def test_every_fit_has_a_method():
    assert {method.fit for method in TABLE} >= set(Fit)


def test_accuracy_is_of_the_newest_steps():
    """A decoder that says its factor, which is the true reward of the newest ten steps and nothing like that before."""
    config, steps = config_of("lare-linear", factors=(1,), rollout_steps=10), steps_of()
    away = np.where(np.arange(TOTAL) < TOTAL - 10, 7.0, 0.5).astype(np.float32)
    factors = steps.after.reward[..., None] + away[:, None, None, None]
    learner = with_steps(untrained(config), config, steps, factors)
    learner = says_its_factor(learner, [1.0])
    # Episodes of one length: those of the newest iteration. Of any length: as many steps as are measured, or as there are.
    same_length = replace(config, env=replace(config.env, fixed_length=True))
    newest, every = jitted(common.assess, same_length)(learner), jitted(common.assess, config)(learner)
    assert float(newest["credit/error"]) == pytest.approx(0.5, rel=1e-5)
    assert float(newest["credit/correlation"]) == pytest.approx(1, rel=1e-4)
    assert float(every["credit/error"]) == pytest.approx((7 * (TOTAL - 10) + 5) / TOTAL, rel=1e-5)


def says_its_factor(learner, signs):
    """With decoders that say the number that stands in their only factor, each with a sign of its own."""
    credit = tuple(
        one._replace(
            decoder=LinearDecoder(Basis(1, 0, False), *(jnp.array([x]) for x in (0.0, 1.0, sign)), jnp.zeros(()))
        )
        for one, sign in zip(learner.credit, signs, strict=True)
    )
    return learner._replace(credit=credit)


# Several environments.


@pytest.mark.parametrize("method", [*map(long, ("rd", "rrdu", "lare-rd")), "lare-linear", "ircr"])
def test_two_environments_are_one_twice_as_long(method):
    """The same episodes, collected side by side or one after the other: the same statistics, the same rewards, the same fit."""
    wide, long = config_of(method, environments=2), config_of(method)
    steps = steps_of(envs=2)
    factors = factors_for(wide, steps)

    def in_a_row(rows):
        return np.swapaxes(rows, 0, 1).reshape(2 * TOTAL, 1, *rows.shape[2:])

    one = with_steps(untrained(wide), wide, steps, factors)
    other = with_steps(untrained(long), long, jax.tree.map(in_a_row, steps), in_a_row(factors))
    close(one.credit, other.credit, 1e-3, 1e-4)
    close(one.scale, other.scale)
    number = jnp.broadcast_to(jnp.arange(TOTAL), (2, TOTAL))
    env = jnp.broadcast_to(jnp.arange(2)[:, None], (2, TOTAL))
    rewards = []
    for learner, config, index in (
        (one, wide, replay.Index(env, number)),
        (other, long, replay.Index(0 * env, number + TOTAL * env)),
    ):
        rewards.append(jitted(common.rewards, config)(read(learner.replay, index), paid_by(learner)))
    close(*rewards, 1e-3, 1e-4)


# Many agents.


@pytest.mark.parametrize("method", ["rd", long("stas"), "lare-rd"])
def test_what_decoders_see_of_many(method):
    """RD and AREL what each agent met after the step, STAS what it met before it and did, LaRe the factors."""
    config = MANY(method)
    drawn, steps = every_step(stored(config)), steps_of(TOGETHER)
    want = {
        "rd": drawn.after.get("observation"),
        "stas": np.concatenate([steps.before.observation, steps.action], axis=-1)[:, 0],
        "lare-rd": factors_for(config, steps)[:, 0],
    }[method]
    np.testing.assert_array_equal(common.features(drawn, config, 0), want)
    assert config.bases[0].inputs == want.shape[-1]


def test_each_team_has_a_decoder_and_a_return_of_its_own():
    config, steps = TEAMS("lare-rd"), steps_of(RIVALS)
    learner = stored(config)
    assert [credit.statistics.mean.shape for credit in learner.credit] == [(2,), (3,)]
    for place, (credit, team) in enumerate(zip(learner.credit, RIVALS.teams, strict=True)):
        earned = earnings(steps, team)
        means = np.array([part.mean() for part in np.split(earned, ENDS)])
        assert float(credit.scale.mean_square) == pytest.approx(float((means**2).mean()), rel=1e-4)
        np.testing.assert_array_equal(credit.scale, learner.scale[place])
    after, _ = fitted(learner, config)
    for before, now in zip(learner.credit, after, strict=True):
        assert not jax.tree.all(jax.tree.map(jnp.array_equal, before.decoder, now.decoder))


def earnings(steps, team, env=0):
    """Of a team by each step: the mean over those of its agents who acted, by a loop."""
    found = []
    for paid, alive in zip(steps.after.reward[:, env], steps.before.alive[:, env], strict=True):
        own = [paid[agent] for agent in range(team.start, team.stop) if alive[agent]]
        found.append(np.mean(own) if own else 0.0)
    return np.array(found)


@pytest.mark.parametrize("method", ["dense", "episodic", "ircr"])
def test_rewards_of_teams(method):
    config, steps = TEAMS(method), steps_of(RIVALS)
    learner, alive = stored(config), steps.before.alive[:, 0]
    got = np.asarray(jitted(common.rewards, config)(every_step(learner), paid_by(learner)))
    assert not alive.all()
    for team in RIVALS.teams:
        of_team = np.split(earnings(steps, team), ENDS)
        if method == "dense":
            want = steps.after.reward[:, 0, team.agents]
        elif method == "episodic":
            want = np.where(steps.ended, np.repeat([one.sum() for one in of_team], LENGTHS)[:, None], 0)
        else:
            means = np.array([one.mean() for one in of_team])
            want = np.repeat((means - means.min()) / (means.max() - means.min()), LENGTHS)[:, None]
        np.testing.assert_allclose(got[:, team.agents], want * alive[:, team.agents], rtol=1e-3, atol=1e-5)


def numbered():
    """Two teams whose decoders say their only factor, which is another number at every row, the second one with a minus."""
    config, steps = TEAMS("lare-linear", factors=(1, 1)), steps_of(RIVALS)
    number = np.arange(TOTAL * 5, dtype=np.float32).reshape(TOTAL, 1, 5)
    learner = says_its_factor(with_steps(untrained(config), config, steps, number[..., None]), [1.0, -1.0])
    return config, learner, steps, number[:, 0] * np.repeat([1.0, -1.0], [3, 2])


def test_every_agent_has_the_proxy_rewards_of_its_own_steps():
    config, learner, steps, own = numbered()
    got = jitted(common.rewards, config)(every_step(learner), paid_by(learner))
    np.testing.assert_array_equal(got, own * steps.before.alive[:, 0])


def test_shared_credit_is_the_mean_over_the_agents_who_are_there():
    config, learner, steps, own = numbered()
    shared = replace(config, method=replace(config.method, shared=True))
    got = np.asarray(jitted(common.rewards, shared)(every_step(learner), paid_by(learner)))
    alive = steps.before.alive[:, 0]
    for row, there, numbers in zip(got, alive, own, strict=True):
        for team in RIVALS.teams:
            some = there[team.agents]
            want = numbers[team.agents][some].mean() if some.any() else 0
            np.testing.assert_allclose(row[team.agents], want * some, rtol=1e-5)


def test_every_team_is_measured_by_itself_and_by_those_who_are_there():
    """Decoders that say the true reward, and its negative; of who has left, something else."""
    config, steps = TEAMS("lare-linear", factors=(1, 1)), steps_of(RIVALS)
    alive = steps.before.alive
    factors = np.where(alive, steps.after.reward, 1e3)[..., None]
    learner = says_its_factor(with_steps(untrained(config), config, steps, factors), [1.0, -1.0])
    found = jitted(common.assess, config)(learner)
    assert {name: round(float(value), 3) for name, value in found.items() if "correlation" in name} == {
        "credit/correlation": 1,
        "credit/correlation_first": 1,
        "credit/correlation_second": -1,
    }
    assert float(found["credit/error"]) == float(found["credit/error_first"]) == pytest.approx(0, abs=1e-6)
    true, there = steps.after.reward[..., 3:], alive[..., 3:]
    assert float(found["credit/error_second"]) == pytest.approx(2 * np.abs(true[there]).mean(), rel=1e-4)


def test_a_closed_form_takes_the_mean_over_steps_and_over_agents_who_are_there():
    config, steps = TEAMS("lare-linear"), steps_of(RIVALS)
    factors, learner = factors_for(config, steps), stored(config)
    for credit, team, size in zip(learner.credit, RIVALS.teams, config.factors, strict=True):
        rows = []
        for of_step, alive in zip(
            factors[:, 0, team.agents, :size], steps.before.alive[:, 0, team.agents], strict=True
        ):
            rows.append(of_step[alive].mean(axis=0) if alive.any() else np.full(size, np.nan))
        check_closed_form(credit, np.split(np.array(rows), ENDS), np.split(earnings(steps, team), ENDS))


@pytest.mark.parametrize("method", ["lare-rd", long("lare-rrdu")])
@pytest.mark.parametrize("fixed_length", [False, long(True)])
def test_must_learn_who_earned_what(method, fixed_length):
    """Of two factors one is the true reward of the agent; the decoder is told the mean over agents and steps."""
    env = EnvSpec((Team("all", 0, 3),), 3, 4, True, 12, agents_leave=not fixed_length, fixed_length=fixed_length)
    config = MANY(
        method,
        env=env,
        environments=8,
        fit_updates=500,
        credit=CreditSettings(hidden=(16,), learning_rate=1e-2, steps=200, drawn_steps=6),
        capacity=200,
        rollout_steps=60,
    )
    lengths = (12,) * 5 if fixed_length else LENGTHS
    steps = steps_of(env, 8, lengths=lengths)
    noise = np.random.default_rng(0).normal(size=steps.after.reward.shape).astype(np.float32)
    learner = with_steps(untrained(config), config, steps, np.stack([steps.after.reward, noise], axis=-1))
    credit, _ = jax.jit(partial(common.fit_often, config=config))(learner, jax.random.key(2))
    found = jitted(common.assess, config)(learner._replace(credit=credit))
    assert float(found["credit/correlation"]) > 0.9
    assert float(found["credit/error"]) < 0.35  # untrained, it is 0.8 and more


# Who has left.

FITTED = ["rd", "rrdu", "vib-rd", "lare-rd", "lare-rrdu", "lare-linear", "lare-signs", "lare-rd-shared", "llm-reward"]


@pytest.mark.parametrize("method", FITTED)
def test_what_stands_where_an_agent_has_left_changes_nothing(method):
    config, steps = MANY(method), steps_of(TOGETHER)
    gone, factors = ~steps.before.alive, factors_for(config, steps)
    assert 0.1 < gone.mean() < 0.5
    # What an agent's own last step led to is of its last step.
    long_gone = gone & np.roll(gone, 1, axis=0) & ~np.roll(steps.ended, 1, axis=0)[..., None]
    assert long_gone.any()
    spoilt = steps._replace(
        before=steps.before._replace(observation=np.where(long_gone[..., None], 99, steps.before.observation)),
        after=steps.after._replace(
            observation=np.where(gone[..., None], 99, steps.after.observation),
            reward=np.where(gone, 99, steps.after.reward),
        ),
        action=np.where(gone[..., None], np.eye(4, dtype=np.float32)[0], steps.action),
    )
    found = []
    for given, z in ((steps, factors), (spoilt, np.where(gone[..., None], 99, factors).astype(np.float32))):
        learner = with_steps(untrained(config), config, given, z)
        rewards = jitted(common.rewards, config)(every_step(learner), paid_by(learner))
        assert not np.asarray(rewards)[gone[:, 0]].any()
        update = fitted(learner, config) if config.method.descends else ()
        found.append((learner.credit, learner.scale, rewards, update, jitted(common.assess, config)(learner)))
    close(*found)


@pytest.mark.parametrize(
    "method",
    ["dense", "ircr", long("rd"), "rrdu", "lare-rd", "lare-linear", *map(long, ("episodic", "lare-rd-shared"))],
)
def test_an_agent_that_was_never_there_is_as_none(method):
    """Three agents of whom one never acts, and the same two alone."""
    two = replace(TOGETHER, teams=(Team("all", 0, 2),))
    many, few = MANY(method), MANY(method, env=two)
    steps = steps_of(TOGETHER)
    factors = factors_for(many, steps)

    def never(shown):
        alive = shown.alive & (np.arange(3) < 2)
        return shown._replace(alive=alive, reward=shown.reward * (np.arange(3) < 2))

    def without(shown):
        return shown._replace(
            **{name: getattr(shown, name)[:, :, :2] for name in ("observation", "available", "alive", "reward")}
        )

    there = steps._replace(before=never(steps.before), after=never(steps.after))
    alone = there._replace(
        before=without(there.before),
        after=without(there.after),
        action=steps.action[:, :, :2],
        taken=steps.taken[:, :, :2],
    )
    start = untrained(many)
    one = with_steps(start, many, there, factors)
    other = with_steps(untrained(few)._replace(credit=start.credit), few, alone, factors[:, :, :2])
    assert jax.tree.structure(one.credit) == jax.tree.structure(other.credit)
    found = []
    for learner, config in ((one, many), (other, few)):
        rewards = jitted(common.rewards, config)(every_step(learner), paid_by(learner))[:, :2]
        update = fitted(learner, config) if config.method.descends else ()
        found.append((learner.credit, learner.scale, rewards, update, jitted(common.assess, config)(learner)))
    close(*found, 1e-3, 1e-4)


# Judged from the global state.


def judged_by_state(method, **changes):
    return MANY(method, judged_from="state", **changes)


@pytest.mark.parametrize("method", [long("rd"), "rrdu", "rd-linear", long("lare-rd"), "lare-linear", "llm-reward"])
def test_credit_of_the_state_is_one_row_a_step_and_pays_all_who_are_there_alike(method):
    config, steps = judged_by_state(method, factors=(2,) if method[0] == "l" else ()), steps_of(TOGETHER)
    learner = stored(config)
    assert config.judged_rows == 1
    drawn = every_step(learner)
    rows = common.features(drawn, config, 0) if config.method.fit else drawn.before["factors"]
    want = factors_for(config, steps)[:, 0] if config.method.latent else drawn.after["state"][:, None]
    if method == "rd-linear":
        want = np.concatenate([want, np.clip(drawn.before["action"], -1, 1).reshape(TOTAL, 1, -1)], axis=-1)
    np.testing.assert_array_equal(rows, want)
    assert rows.shape[:2] == (TOTAL, 1)
    got = np.asarray(jitted(common.rewards, config)(drawn, paid_by(learner)))
    alive = steps.before.alive[:, 0]
    of_step = got.sum(axis=1) / np.maximum(alive.sum(axis=1), 1)
    np.testing.assert_allclose(got, of_step[:, None] * alive, rtol=1e-5, atol=1e-6)
    assert of_step[alive.any(axis=1)].std() > 0
    if learner.credit:
        assert float(learner.credit[0].statistics.rows) == TOTAL
        if config.method.descends:
            _, measured = fitted(learner, config)
            assert np.isfinite(float(measured["credit/loss"]))


def test_what_is_stored_of_the_state_is_what_it_was():
    config, steps = judged_by_state("rd"), steps_of(TOGETHER)
    drawn = every_step(stored(config))
    np.testing.assert_array_equal(drawn.before["state"], steps.before.state[:, 0])
    np.testing.assert_array_equal(drawn.after["state"], steps.after.state[:, 0])
    assert "observation" not in drawn.before


def test_the_closed_form_of_the_state_against_numpy():
    config, steps = judged_by_state("lare-linear"), steps_of(TOGETHER)
    factors = factors_for(config, steps)
    team = TOGETHER.teams[0]
    credit = stored(config).credit[0]
    check_closed_form(credit, np.split(factors[:, 0, 0], ENDS), np.split(earnings(steps, team), ENDS))


def test_credit_of_the_state_is_measured_against_what_the_team_earned():
    config, steps = judged_by_state("lare-linear", factors=(1,)), steps_of(TOGETHER)
    earned = earnings(steps, TOGETHER.teams[0]).astype(np.float32)
    learner = with_steps(untrained(config), config, steps, 0.5 + earned[:, None, None, None])
    found = jitted(common.assess, config)(says_its_factor(learner, [1.0]))
    assert float(found["credit/error"]) == pytest.approx(0.5, rel=1e-4)
    assert float(found["credit/correlation"]) == pytest.approx(1, rel=1e-4)


@pytest.mark.parametrize(("env", "score"), [(ALONE, "sum"), long(TOGETHER, "average")])
def test_optimism_adds_deviations_to_what_is_paid_and_to_nothing_else(env, score):
    algorithm = "td3" if env is ALONE else "ippo"
    plain, hopeful = (
        config_of("lare-bayes", algorithm, env, credit=CreditSettings(score=score, optimism=optimism))
        for optimism in (0.0, 2.0)
    )
    one, other = stored(plain), stored(hopeful)
    steps, paid = every_step(one), paid_by(other)
    before = np.asarray(jitted(common.rewards, plain)(steps, paid_by(one)))
    after = np.asarray(jitted(common.rewards, hopeful)(steps, paid))
    features = common.features(steps, hopeful, 0)
    with jax.enable_x64(True):
        rows = features.reshape(-1, features.shape[-1])
        deviation = np.asarray(returns.deviation(other.credit[0], rows, hopeful.forms)).reshape(before.shape)
    parts = np.where(other.credit[0].average, np.asarray(steps.length), 1).reshape(-1, 1)
    alive = np.asarray(common.alive(steps, hopeful))
    np.testing.assert_allclose(after, np.where(alive, before + 2 * deviation / parts, 0), rtol=1e-3, atol=1e-5)
    assert (after[alive] > before[alive]).all()
    np.testing.assert_array_equal(np.where(alive, jitted(proxy_rewards, hopeful)(steps, paid), 0), before)
    for name, value in jitted(common.assess, plain)(one).items():
        np.testing.assert_array_equal(jitted(common.assess, hopeful)(other)[name], value)


def test_optimism_waits_for_two_returns():
    config = config_of("bayes", credit=CreditSettings(optimism=2.0))
    learner = untrained(config)
    paid = jitted(common.rewards, config)(every_step(stored(config)), paid_by(learner))
    np.testing.assert_array_equal(paid, 0)
