"""Credit as pure functions: it recovers rewards from returns, and works under JAX's transformations."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.sharding import PartitionSpec

import lare_rl
from lare_rl.credit.decoder_settings import CreditSettings, resolve_credit
from lare_rl.errors import LareError
from lare_rl.training.pure_credit import CreditSteps, pure_credit

N_ENVS, N_STEPS, LENGTH = 4, 20, 10
WEIGHT = np.array([1.0, -2.0, 0.5], np.float32)
SIZES = {"observation_size": 2, "action_size": 1, "n_envs": N_ENVS, "n_steps": N_STEPS, "max_steps": LENGTH}
SUM = {**SIZES, "settings": CreditSettings(score="sum")}
"""Nothing is fitted to find out the type of the score, which takes seconds to compile."""


def make_steps(key, agents=()):
    """Return steps whose reward is linear in next observation and action; episodes have ten steps."""
    state_key, action_key = jax.random.split(key)
    states = jax.random.normal(state_key, (N_STEPS + 1, N_ENVS, *agents, 2))
    observation, next_observation = states[:-1], states[1:]
    action = jax.random.uniform(action_key, (N_STEPS, N_ENVS, *agents, 1), minval=-1, maxval=1)
    true_reward = jnp.concatenate([next_observation, action], axis=-1) @ WEIGHT
    last = jnp.broadcast_to((jnp.arange(N_STEPS) % LENGTH == LENGTH - 1)[:, None], (N_STEPS, N_ENVS))
    returns = true_reward.reshape(-1, LENGTH, *true_reward.shape[1:]).sum(axis=1).repeat(LENGTH, axis=0)
    episodic_reward = jnp.where(last.reshape(*last.shape, *[1] * len(agents)), returns, 0)
    return CreditSteps(observation, action, next_observation, episodic_reward, last, jnp.zeros_like(last)), true_reward


def correlation(x, y):
    return float(np.corrcoef(np.ravel(x), np.ravel(y))[0, 1])


def train(credit, key, n_rounds=30, make=make_steps):
    """Observe and refit in a compiled loop. Return the state."""

    def body(state, key):
        return credit.refit(credit.observe(state, make(key)[0]), key), None

    init_key, key = jax.random.split(key)
    return jax.lax.scan(body, credit.init(init_key), jax.random.split(key, n_rounds))[0]


@pytest.mark.long
def test_rewards_are_recovered_from_returns():
    credit = pure_credit("rrdu", **SUM, fit_updates=100)
    steps, true_reward = make_steps(jax.random.key(1))
    r_hat = jax.jit(lambda key: credit.reward(train(credit, key), steps))(jax.random.key(0))
    assert r_hat.shape == (N_STEPS, N_ENVS)
    assert correlation(r_hat, true_reward) > 0.9


def test_phi_reads_actions_in_the_units_of_the_environment(reward):
    credit = pure_credit("llm-reward", reward, **SIZES, low=-3.0, high=1.0)
    steps, _ = make_steps(jax.random.key(1))
    r_hat = jax.jit(lambda key: credit.reward(credit.init(key), steps))(jax.random.key(0))
    rows = [np.asarray(x).reshape(N_STEPS * N_ENVS, -1) for x in (steps.observation, 2 * steps.action - 1)]
    after = np.asarray(steps.next_observation).reshape(N_STEPS * N_ENVS, -1)
    expected = reward.step_factors(*rows, after, "after")
    np.testing.assert_allclose(np.ravel(r_hat), np.ravel(expected), rtol=1e-5, atol=1e-5)


@pytest.mark.long
def test_invalid_factors_are_counted_and_not_used(phi):
    """A step is invalid where the observation is NaN. `lare-rrdu` reads factors alone. Phi is part of the program."""
    credit = pure_credit("lare-rrdu", phi, **SUM, fit_updates=2)
    # Step 9 is the last one of an episode.
    is_invalid = jnp.zeros((N_STEPS, N_ENVS), bool).at[[3, 9, 14], [0, 1, 2]].set(True)

    def steps_of(key):
        steps, true_reward = make_steps(key)
        observation = jnp.where(is_invalid[..., None], jnp.nan, steps.next_observation)
        return steps._replace(next_observation=observation), true_reward

    state = jax.jit(lambda key: train(credit, key, make=steps_of))(jax.random.key(0))
    assert int(state.n_invalid) == 90
    assert int(optax.tree_utils.tree_get(state.learner.decoders[0].optimizer, "count")) == 30 * 2
    steps, _ = steps_of(jax.random.key(1))
    reward = jax.jit(credit.reward)
    r_hat = np.asarray(reward(state, steps))
    assert (r_hat[is_invalid] == 0).all()
    valid, _ = make_steps(jax.random.key(1))
    assert "callback" not in str(jax.make_jaxpr(credit.observe)(state, valid))
    expected = np.asarray(reward(state, valid))
    np.testing.assert_array_equal(r_hat[~is_invalid], expected[~is_invalid])
    assert np.isfinite(expected).all()
    assert float(state.learner.replay.episode_return.max()) != 0  # the reward of an invalid last step counts


@pytest.mark.long
def test_functions_are_mapped_over_seeds():
    """`vmap` within `shard_map` gives what single calls give: the rewards of many agents behind the returns."""
    settings = resolve_credit(None, 3).model_copy(update={"score": "sum"})
    credit = pure_credit("bayes", **SIZES, settings=settings, agents=3)
    make, keys = partial(make_steps, agents=(3,)), jax.random.split(jax.random.key(0), 2)
    steps, true_reward = make(jax.random.key(1))
    run = jax.jit(lambda key: credit.reward(train(credit, key, make=make), steps))
    expected = jnp.stack([run(key) for key in keys])
    assert expected.shape == (2, N_STEPS, N_ENVS, 3)
    assert np.corrcoef(expected[0].ravel(), true_reward.ravel())[0, 1] > 0.9
    mesh, spec = jax.sharding.Mesh(jax.devices()[:1], ("seeds",)), PartitionSpec("seeds")
    sharded = jax.shard_map(jax.vmap(run), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    np.testing.assert_allclose(jax.jit(sharded)(keys), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"method": "episodic"}, "bayes"),
        ({"method": "stas"}, "bayes"),
        ({"method": "lare-bayes"}, "phi"),
        ({"method": "bayes", "settings": CreditSettings(exact="last")}, "exact"),
        ({"method": "rrd", "settings": CreditSettings(batch_steps=16)}, "sampled_steps"),
        ({"method": "nothing"}, "nothing"),
        ({"n_envs": 0}, "n_envs = 0"),
        ({"low": [0.0, 0.0]}, r"low = \[0.0, 0.0\].*\(1,\)"),
        ({"high": "wide"}, "high = 'wide'"),
    ],
)
def test_pure_credit_refuses(arguments, words):
    with pytest.raises(LareError, match=words):
        lare_rl.pure_credit(**({"method": "bayes"} | SIZES | arguments))


@pytest.mark.parametrize("name", ["observation", "action", "next_observation", "reward"])
def test_steps_of_other_sizes_are_refused(name):
    credit, (steps, _) = pure_credit("bayes", **SUM), make_steps(jax.random.key(0))
    values = jnp.stack(2 * [getattr(steps, name)], axis=-1)
    with pytest.raises(LareError, match=rf"{name} has the shape \(20, 4,"):
        credit.reward(credit.init(jax.random.key(0)), steps._replace(**{name: values}))
    swapped = jnp.swapaxes(getattr(steps, name), 0, 1)
    with pytest.raises(LareError, match=rf"{name} has the shape \(4, 20"):
        credit.reward(credit.init(jax.random.key(0)), steps._replace(**{name: swapped}))
