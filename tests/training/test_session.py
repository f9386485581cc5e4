"""The order of an iteration. Iterations in one compiled call make the same training state as iterations on the host."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_toy_envs import echo_spec
from helpers.small_configs import ONE_TEAM, random_steps, small_config, untrained_learner
from helpers.training_runs import ECHO_PHI, QUICK_CREDIT
from lare_rl.config.resolve import resolve
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.runs.directory import create_run
from lare_rl.training import session
from lare_rl.training.session import Session, start_session


class BareSession(Session):
    """A session of two seeds without environments, and with other functions."""

    def __init__(self, config, **functions):
        self.config, self.functions, self.run = config, SimpleNamespace(**functions), SimpleNamespace(seeds=[0, 1])
        self.learner, self.latest_metrics = untrained_learner(config), {}


def test_update_fits_decoders_before_the_algorithm():
    """Iterations have 20 steps, and the decoders are fitted in every second of them."""
    config, calls = small_config("lare-rd", "ippo", rollout_steps=20, fit_every=2), []

    def fit(learner, keys):
        calls.append("fit")
        return learner, {"credit/loss": jnp.ones(2)}

    def train_step(learner, steps, keys, step):
        calls.append(("train", step))
        return learner, {}

    training = BareSession(config, fit=fit, train_step=train_step)
    for training.step in (80, 100, 120):
        training._update(random_steps())
    assert calls == ["fit", ("train", 80), ("train", 100), "fit", ("train", 120)]
    assert {name: values.tolist() for name, values in training.latest_metrics.items()} == {"credit/loss": [1, 1]}


def test_update_keeps_the_metrics_of_seeds_without_updates():
    config, metrics = small_config("episodic", "qmix", env=ONE_TEAM), []
    training = BareSession(config, train_step=lambda learner, *_: (learner, metrics.pop(0)))
    for updates, losses, latest in [
        ([0, 0], [np.nan, np.nan], {}),
        ([2, 0], [3, np.nan], {"algorithm/updates": [2, 0], "loss": [3, np.nan]}),
        ([0, 1], [np.nan, 5], {"algorithm/updates": [2, 1], "loss": [3, 5]}),
        ([0, 0], [np.nan, np.nan], {"algorithm/updates": [2, 1], "loss": [3, 5]}),
    ]:
        metrics.append({"algorithm/updates": jnp.array(updates, float), "loss": jnp.array(losses)})
        training._update(random_steps())
        np.testing.assert_equal(
            {name: list(map(float, values)) for name, values in training.latest_metrics.items()}, latest
        )


@pytest.fixture(scope="module")
def begin(small_many, tmp_path_factory):
    """Begins runs on the echo toy, whose agents leave; an iteration has ten steps, an episode three to six.

    Factors are computed from the observation before a step, which a test can make infinite.
    """
    function = verify_function(ECHO_PHI, echo_spec())

    def begin(algorithm, method):
        changes = {"environments": 2, "rollout_steps": 10, "steps": 80, "evaluate_every": 80, "fit_every": 2}
        changes |= {"credit": QUICK_CREDIT, "scored_observation": "before"}
        settings = small_many(algorithm=algorithm, method=method, **changes)
        directory = tmp_path_factory.mktemp("loop") / "run"
        return start_session(create_run(directory, echo_spec(), resolve(settings, echo_spec()), [function]))

    return begin


def assert_equal_sessions(training, other):
    states = [(s.learner, s.collector.envs, s.latest_metrics) for s in (training, other)]
    for (path, leaf), (_, other_leaf) in zip(*map(jax.tree_util.tree_leaves_with_path, states), strict=True):
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf, other_leaf = map(jax.random.key_data, (leaf, other_leaf))
        np.testing.assert_allclose(leaf, other_leaf, rtol=1e-4, atol=1e-5, err_msg=jax.tree_util.keystr(path))


@pytest.mark.long
@pytest.mark.parametrize(
    ("algorithm", "method"),
    [
        ("ippo", "lare-rd"),
        ("ippo", "lare-bayes"),
        ("qmix", "lare-rd"),
        ("qmix", "lare-bayes"),
    ],
)
def test_advance_equals_host_iterations(algorithm, method, begin, monkeypatch):
    monkeypatch.setattr(session, "MAX_CALL_S", 1e6)
    compiled, host = begin(algorithm, method), begin(algorithm, method)
    host.loop = None
    for _ in range(4):
        host.advance(80)
    compiled.advance(20)
    compiled.advance(80)
    assert compiled.step == host.step == 80
    assert_equal_sessions(compiled, host)


@pytest.mark.long
def test_advance_stops_at_a_factor_that_is_not_finite(begin):
    training = begin("ippo", "lare-rd")
    training.advance(20)
    envs = training.collector.envs
    observation = envs.timestep.observation.at[1].set(np.inf)
    training.collector.envs = envs._replace(timestep=envs.timestep._replace(observation=observation))
    with pytest.raises(LareError, match=r"factor .*failed_batch.npz"):
        training.advance(80)
    assert training.step == 20
