"""Episodes in which each step has a cause, and the last one says what came of all causes: the outcome."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.credit_specs import observation_spec
from lare_rl.credit import closed_form, decoder_state, evidence, learning, terminal
from lare_rl.credit.basis import Basis
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.factor_fit import assess_factors
from lare_rl.credit.methods import METHODS
from lare_rl.nn.normalise import RunningMeanStd, running_std
from lare_rl.util.float64 import float64

CAUSE, OUTCOME, CONSTANT = range(3)
N_EPISODES = 300


def sample(lengths, seed=0):
    """Return the rows of episodes, and their returns: R = 3 causes + noise, and the outcome is R."""
    rng, ends = np.random.default_rng(seed), np.cumsum(lengths) - 1
    rows = np.zeros((lengths.sum(), 1, 3), np.float32)
    rows[:, 0, CAUSE], rows[:, 0, CONSTANT] = rng.normal(size=len(rows)), 2.0
    returns = 3 * np.add.reduceat(rows[:, 0, CAUSE], ends + 1 - lengths) + 3 * rng.normal(size=len(lengths))
    rows[ends, 0, OUTCOME] = returns
    return rows, returns


def fit(lengths, method="rd-linear", score="sum"):
    """Return the state after a fit to sampled episodes, their mean features, and R/T."""
    rows, returns = sample(lengths)
    if score == "binary":
        returns = np.sign(returns)
    spec = observation_spec(3, METHODS[method], CreditSettings(score=score), int(lengths.max()), fixed_length=False)
    state = fit_rows(spec, rows, returns, lengths)
    with float64():
        means = np.asarray(learning.mean_features(state.closed_form.decoder, make_batch(rows, returns, lengths)))
    return state, means, returns / lengths


def make_batch(rows, returns, lengths, alive=None):
    return CreditBatch(
        inputs=jnp.asarray(rows),
        episode_index=jnp.repeat(jnp.arange(len(lengths)), lengths),
        length=jnp.asarray(lengths),
        mean_reward=jnp.asarray(returns / lengths),
        mask=jnp.ones(len(lengths)),
        alive=alive,
    )


def fit_rows(spec, rows, returns, lengths):
    batch = make_batch(rows, returns, lengths)
    state = decoder_state.init(jax.random.key(0), spec)
    state = decoder_state.observe_steps(state, batch.inputs)
    with float64():
        closed = learning.add_to_sums(closed_form.reset_statistics(state.closed_form, state.statistics), batch)
        return jax.jit(learning.fit_closed_form, static_argnums=1)(state._replace(closed_form=closed), spec)


def test_fit_pays_a_terminal_input_what_all_others_leave():
    """Two regressions, each by ordinary least squares with the weights T, as there are many episodes."""
    lengths = np.random.default_rng(1).integers(2, 8, N_EPISODES)
    state, means, y = fit(lengths)
    weight = np.asarray(state.network.weight)
    first = np.stack([np.ones(N_EPISODES), means[:, CAUSE], 1 / lengths], axis=1) * np.sqrt(lengths)[:, None]
    solution = np.linalg.lstsq(first, y * np.sqrt(lengths))[0]
    residual = y - first @ solution / np.sqrt(lengths)
    second = np.stack([np.ones(N_EPISODES), means[:, OUTCOME]], axis=1) * np.sqrt(lengths)[:, None]
    _, slope = np.linalg.lstsq(second, residual * np.sqrt(lengths))[0]
    assert weight[CAUSE] == pytest.approx(solution[1], rel=0.01)
    assert weight[OUTCOME] == pytest.approx(slope, rel=0.1)
    assert weight[CONSTANT] == 0
    assert weight[CAUSE] / state.network.std[CAUSE] == pytest.approx(3, rel=0.1)


def test_fit_of_an_average_leaves_the_rest_to_a_terminal_input():
    """R is fitted, not R/T."""
    state, means, y = fit(np.full(N_EPISODES, 5), score="average")
    weight, returns = np.asarray(state.network.weight), y * 5
    first = np.stack([np.ones(N_EPISODES), means[:, CAUSE]], axis=1)
    solution = np.linalg.lstsq(first, returns)[0]
    second = np.stack([np.ones(N_EPISODES), means[:, OUTCOME]], axis=1)
    _, slope = np.linalg.lstsq(second, returns - first @ solution)[0]
    assert weight[CAUSE] == pytest.approx(solution[1], rel=0.01)
    assert weight[OUTCOME] == pytest.approx(slope, rel=0.1)


def test_an_end_that_is_always_the_same_is_told_from_the_start_value_by_the_evidence():
    """A fall costs 20 at the end of each episode. Nothing else may be paid for it, such as the time, which goes with the length."""
    rng = np.random.default_rng(0)
    inputs, returns = [], []
    for length in rng.integers(3, 30, 150):
        rows = np.zeros((length, 1, 3), np.float32)
        rows[:, 0, 0], rows[:, 0, 1], rows[-1, 0, 2] = rng.normal(size=length), np.arange(length) / 30, 1
        inputs.append(rows)
        returns.append(rows[:, 0, 0].sum() - 20 + 0.3 * rng.normal())
    alive = [np.ones((len(rows), 1), bool) for rows in inputs]
    basis = Basis(3, 0, extended=False)
    explanation = assess_factors(inputs, alive, np.array(returns), basis, score="sum").explanation
    assert explanation.terminal.tolist() == [False, False, True]
    assert float(explanation.factors_r2) > 0.95
    assert explanation.factor_shares[0] > 0.9
    assert abs(explanation.slope[1]) < 0.05


def test_the_start_value_is_fitted_again_beside_a_constant_end():
    """An episode costs 20, by its start or by its end, which returns cannot tell apart. So the two share it."""
    lengths = np.random.default_rng(1).integers(2, 8, N_EPISODES)
    rows, returns = sample(lengths)
    ends = np.cumsum(lengths) - 1
    returns -= 20
    rows[ends, 0, OUTCOME] = 1
    spec = observation_spec(3, METHODS["rd-linear"], CreditSettings(score="sum"), 7, fixed_length=False)
    state = fit_rows(spec, rows, returns, lengths)
    end_reward = float(state.network.weight[OUTCOME] / state.network.std[OUTCOME])
    assert -18 < end_reward < -2
    assert -18 < float(decoder_state.start_value(state)) < -2
    assert float(decoder_state.explained_start_value(state)) == pytest.approx(-20, abs=2)


def test_rows_of_agents_that_did_not_act_do_not_count():
    """The second agent's outcome varies before the end, where it does not act."""
    lengths = np.full(20, 4)
    rows, returns = sample(lengths)
    rows = np.repeat(rows, 2, axis=1)
    alive = np.ones(rows.shape[:2], bool)
    rows[::4, 1, OUTCOME], alive[::4, 1] = 7.0, False
    batch = make_batch(rows, returns, lengths, jnp.asarray(alive))
    spec = observation_spec(3, METHODS["rd-linear"], CreditSettings(), 4, agents=2)
    state = decoder_state.init(jax.random.key(0), spec)
    with float64():
        closed = learning.add_to_sums(state.closed_form, batch)
    assert float(closed.before_end.n_rows) == 20 * 3 * 2 - 20
    assert running_std(closed.before_end).tolist()[1:] == [0, 0]
    reset = closed_form.reset_statistics(closed, state.statistics)
    assert float(reset.before_end.n_rows) == 0


def test_fit_in_episodes_of_one_step_knows_no_end():
    state, _, _ = fit(np.ones(N_EPISODES, int))
    weight = np.asarray(state.network.weight) / np.where(state.network.std > 0, state.network.std, 1)
    np.testing.assert_allclose(weight, [0, 1, 0], atol=0.01)


def test_fit_of_log_odds_ignores_terminal_inputs():
    state, _, _ = fit(np.random.default_rng(1).integers(2, 8, N_EPISODES), "bayes", "binary")
    closed = state.closed_form
    statistics = evidence.to_float64(closed.sufficient_statistics)
    columns = np.asarray(terminal.terminal_columns(closed.decoder.basis, statistics, closed.before_end))
    weight = np.asarray(closed.log_odds.posterior.weight)
    assert not weight[columns].any()
    assert weight[~columns].any()
    assert not np.asarray(closed.log_odds.root)[:, columns].any()


def test_reward_std_counts_terminal_inputs():
    state, _, _ = fit(np.random.default_rng(1).integers(2, 8, N_EPISODES))
    rows = jnp.asarray([[1.0, 0.0, 2.0], [1.0, 9.0, 2.0]])
    with float64():
        std = np.asarray(closed_form.reward_std(state.closed_form, rows, (0, 1), 0))
    assert 0 < std[0] < std[1] < 1


@pytest.mark.parametrize(
    ("n_rows", "spread", "prefixes", "want"),
    [
        (terminal.MIN_STEPS, [0, 1], False, [True, False, True, True]),
        (terminal.MIN_STEPS, [1, 1], False, [False] * 4),
        (terminal.MIN_STEPS - 1, [0, 0], False, [False] * 4),
        (terminal.MIN_STEPS, [0, 1], True, [False] * 4),
    ],
)
def test_terminal_columns(n_rows, spread, prefixes, want):
    """The columns of two factors, the first cosine of the first one, and their pair. Those of the second sine do not vary."""
    basis = Basis(2, 0, extended=True, prefixes=prefixes)
    before_end = RunningMeanStd(jnp.float32(n_rows), jnp.ones(2), jnp.float32(spread))
    variation = np.ones(basis.n_columns + 2)
    variation[5] = 0
    statistics = evidence.empty_statistics(basis.n_columns)
    statistics = statistics._replace(n_steps=jnp.float32(n_rows), products=jnp.diag(jnp.asarray(variation)))
    columns = np.asarray(terminal.terminal_columns(basis, statistics, before_end))
    assert columns[[0, 1, 2, basis.n_features - 1]].tolist() == want
    assert not columns[5]
