"""Finished runs that many tests read. They share one compiled program; a test that changes files works on a copy."""

import pytest

import lare_rl
from helpers.jax_toy_envs import echo_spec
from helpers.listeners import MessageListener
from helpers.toy_envs import toy_spec
from helpers.training_runs import CHASE, ECHO_PHI, QUICK_CREDIT, train_quietly
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.latent.function import verify_function


@pytest.fixture(scope="session")
def dense(small):
    """Settings of a run with true rewards, whose replay holds three episodes."""
    return lambda **changes: small(method="dense", capacity=64, **changes)


@pytest.fixture(scope="session")
def dense_training(dense, tmp_path_factory):
    """A run of 240 steps, and its messages."""
    listener = MessageListener()
    run = train_quietly(CHASE, dense(), tmp_path_factory.mktemp("dense") / "run", listeners=[listener])
    return run, listener.messages


@pytest.fixture(scope="session")
def dense_run(dense_training):
    return dense_training[0]


@pytest.fixture(scope="session")
def factor_run(small, phi, tmp_path_factory):
    """A run of 240 steps with a latent function from a file, which scores the observations before and after a step."""
    directory = tmp_path_factory.mktemp("factors")
    phi.save(directory / "phi.py")
    return train_quietly(toy_spec(), small(scored_observation="both"), directory / "run", directory / "phi.py")


@pytest.fixture(scope="session")
def learned_training(phi, tmp_path_factory):
    """A run of TD3 with lare-bayes that has learned the toy, and its messages."""
    settings = lare_rl.Settings(
        algorithm="td3",
        method="lare-bayes",
        steps=1200,
        rollout_steps=20,
        evaluate_every=1200,
        td3={"hidden": (32,), "learning_rate": 3e-3, "batch_size": 64, "gamma": 0.5, "warmup": 400},
        credit=CreditSettings(batch_steps=64),
    )
    listener = MessageListener()
    run = train_quietly(toy_spec(), settings, tmp_path_factory.mktemp("learned") / "run", phi, [listener])
    return run, listener.messages


@pytest.fixture(scope="session")
def echo_settings(small_many):
    """An iteration has ten steps, an episode of echo three to six: iterations end in the middle of episodes."""
    changes = {"environments": 2, "rollout_steps": 10, "steps": 80, "evaluate_every": 20, "credit": QUICK_CREDIT}
    return small_many(algorithm="ippo", method="lare-linear", scored_observation="both", **changes)


@pytest.fixture(scope="session")
def echo_run(echo_settings, tmp_path_factory):
    """A run of agents that leave, in JAX."""
    function = verify_function(ECHO_PHI, echo_spec())
    return train_quietly(echo_spec(), echo_settings, tmp_path_factory.mktemp("echo") / "run", function)


@pytest.fixture(scope="session")
def hosted_settings(small_many):
    changes = {"environments": 1, "rollout_steps": 20, "steps": 80, "evaluate_every": 20, "evaluation_episodes": 2}
    return small_many(algorithm="ippo", method="rd-linear", credit=QUICK_CREDIT, **changes)


@pytest.fixture(scope="session")
def hosted_run(hosted_settings, tmp_path_factory):
    """The same toy, stepped on the host."""
    out = tmp_path_factory.mktemp("hosted") / "run"
    return train_quietly(echo_spec(environment="hosted/three"), hosted_settings, out)
