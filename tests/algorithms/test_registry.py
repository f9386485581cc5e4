from dataclasses import replace

import pytest

from lare_rl.algorithms.registry import ALGORITHMS, register_algorithm
from lare_rl.errors import LareError


def test_rows_and_what_register_algorithm_refuses():
    rollouts = {"ppo", "ippo"}
    for discrete, n_agents, names in ((True, 1, rollouts), (False, 1, set()), (False, 3, rollouts)):
        samples = {name for name, row in ALGORITHMS.items() if not row.deterministic_evaluation(discrete, n_agents)}
        assert samples == names
    register_algorithm(ALGORITHMS["td3"])
    with pytest.raises(LareError, match="'td3'"):
        register_algorithm(replace(ALGORITHMS["sac"], name="td3"))
    for name, base in (("td3", "OffPolicySettings"), ("vdn", "SequenceSettings")):
        message = f"algorithm mine: .* consumes {ALGORITHMS[name].consumes} derive from .*:{base}"
        with pytest.raises(LareError, match=message):
            register_algorithm(replace(ALGORITHMS[name], name="mine", settings=ALGORITHMS["ppo"].settings))
    for name, changes in (
        ("td3", {"discrete": True}),
        ("sac", {"multi_agent": True}),
        ("vdn", {"continuous": True}),
        ("qmix", {"multi_team": True}),
    ):
        with pytest.raises(LareError, match=r"algorithm mine: .* consumes .* trains .*False"):
            register_algorithm(replace(ALGORITHMS[name], name="mine", **changes))
    algorithm = replace(ALGORITHMS["ppo"], name="mine")
    object.__setattr__(algorithm, "consumes", "rollouts")  # type checks are only made in tests
    with pytest.raises(LareError, match="algorithm mine: consumes is 'rollouts'"):
        register_algorithm(algorithm)
