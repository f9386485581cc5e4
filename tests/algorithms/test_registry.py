from dataclasses import replace

import pytest

from lare_rl.algorithms.registry import ALGORITHMS, register_algorithm
from lare_rl.errors import LareError


@pytest.mark.parametrize("discrete", [False, True])
def test_greedy_samples_distributions_over_choices(discrete):
    stochastic = {name for name, algorithm in ALGORITHMS.items() if not algorithm.deterministic_evaluation(discrete)}
    assert stochastic == ({"ppo", "ippo"} if discrete else {"ippo"})


def test_register_algorithm_refuses_used_name():
    register_algorithm(ALGORITHMS["td3"])
    with pytest.raises(LareError, match="'td3'"):
        register_algorithm(replace(ALGORITHMS["sac"], name="td3"))


def test_consumes_is_a_member():
    algorithm = replace(ALGORITHMS["ppo"], name="mine")
    object.__setattr__(algorithm, "consumes", "rollouts")  # type checks are only made in tests
    with pytest.raises(LareError, match="algorithm mine: consumes is 'rollouts'"):
        register_algorithm(algorithm)


@pytest.mark.parametrize(("name", "base"), [("td3", "OffPolicySettings"), ("vdn", "SequenceSettings")])
def test_settings_must_derive_from_those_of_the_loop(name, base):
    with pytest.raises(
        LareError, match=f"algorithm mine: .* consumes {ALGORITHMS[name].consumes} derive from .*:{base}"
    ):
        register_algorithm(replace(ALGORITHMS[name], name="mine", settings=ALGORITHMS["ppo"].settings))
