import signal

import numpy as np
import pytest

from final_score import child
from final_score.child import ChildEnv

CART = "gymnasium.envs.classic_control.cartpole:CartPoleEnv"


@pytest.fixture
def cart():
    env = ChildEnv(CART, {})
    yield env
    env.close()


def test_same_as_in_this_process(cart):
    from gymnasium.envs.classic_control.cartpole import CartPoleEnv

    plain = CartPoleEnv()
    assert cart.action_space == plain.action_space
    assert np.array_equal(cart.reset(seed=1)[0], plain.reset(seed=1)[0])
    for action in (0, 1, 1):
        observation, *rest = cart.step(action)
        plain_observation, *plain_rest = plain.step(action)
        assert np.array_equal(observation, plain_observation)
        assert rest == plain_rest
    assert cart.read("gravity") == 9.8
    cart.close()
    assert cart._process.poll() == 0


def test_errors_name_the_reason(cart):
    with pytest.raises(RuntimeError, match=r"process failed: AttributeError.*'nothing'"):
        cart.read("nothing")
    assert cart.reset(seed=1)[0].shape == (4,)
    with pytest.raises(RuntimeError, match="ModuleNotFoundError: No module named 'nowhere'"):
        ChildEnv("nowhere:Env", {})
    cart._process.kill()
    with pytest.raises(RuntimeError, match="process ended with code -9"):
        cart.reset(seed=1)


def test_hanging_process(cart, monkeypatch):
    monkeypatch.setattr(child, "TIMEOUT_S", 0.2)
    wait = cart._process.wait
    monkeypatch.setattr(cart._process, "wait", lambda timeout=None: wait(timeout and 0.1))
    cart._process.send_signal(signal.SIGSTOP)
    with pytest.raises(TimeoutError, match="no answer"):
        cart.reset(seed=1)
    assert cart._process.poll() is not None
