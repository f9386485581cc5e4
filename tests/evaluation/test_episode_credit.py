import numpy as np
import pytest

import lare_rl
from helpers.toy_envs import pick_spec
from lare_rl.evaluation.episode_credit import load_episode_credit

pytestmark = pytest.mark.long


def test_credit_of_an_exact_method_adds_up(small, tmp_path):
    """PPO predicts returns with each update, and its checkpoint holds no predictions."""
    settings = small(method="bayes", algorithm="ppo", steps=120, capacity=240, credit={"exact": "last"})
    run = lare_rl.train(pick_spec(), settings, out=tmp_path / "run", listeners=[])
    credit = load_episode_credit(run)
    assert credit is not None
    np.testing.assert_allclose(credit.proxy_reward.sum(), credit.reward.sum(), rtol=1e-4, atol=1e-4)
