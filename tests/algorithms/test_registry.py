import subprocess
import sys
from dataclasses import replace

import pytest

from lare_rl.algorithms.registry import ALGORITHMS, register_algorithm
from lare_rl.errors import LareError

PLUGIN = """
from dataclasses import replace

from lare_rl.algorithms.registry import ALGORITHMS, register_algorithm
from lare_rl.algorithms.td3.td3 import TD3Settings, act, get_actor, init, update


class QuietSettings(TD3Settings):
    shift: float = 0.5


def explore(actor, observation, noise, settings):
    return act(actor, observation) * settings.shift


settings = QuietSettings(hidden=(8,), batch_size=8, warmup=50)
register_algorithm(replace(ALGORITHMS["td3"], name="quiet", settings=settings, module=__name__, summary="a test"))
"""

PROGRAM = """
import sys
import lare_rl.cli
for arguments in (["algorithms"], ["train", "--algorithm", "quiet", "--help"]):
    sys.argv[1:] = arguments
    try:
        lare_rl.cli.main()
    except SystemExit:
        pass
settings = lare_rl.Settings(algorithm="quiet", method="dense", steps=100, quiet={"shift": 0.25}, evaluation_episodes=1)
run = lare_rl.train("Reacher-v4", settings, out="run")
print(run.config.settings.hyperparameters)
print(lare_rl.open_run("run").config.settings == run.config.settings)
"""


@pytest.mark.parametrize("discrete", [False, True])
def test_greedy_samples_distributions_over_choices(discrete):
    stochastic = {name for name, algorithm in ALGORITHMS.items() if not algorithm.deterministic_evaluation(discrete)}
    assert stochastic == ({"ppo", "ippo"} if discrete else {"ippo"})


def test_register_algorithm_refuses_used_name():
    register_algorithm(ALGORITHMS["td3"])
    with pytest.raises(LareError, match="'td3'"):
        register_algorithm(replace(ALGORITHMS["sac"], name="td3"))


@pytest.mark.parametrize(("name", "base"), [("td3", "OffPolicySettings"), ("vdn", "QMIXSettings")])
def test_settings_must_derive_from_those_of_the_loop(name, base):
    with pytest.raises(
        LareError, match=f"algorithm mine: .* consumes {ALGORITHMS[name].consumes} derive from .*:{base}"
    ):
        register_algorithm(replace(ALGORITHMS[name], name="mine", settings=ALGORITHMS["ppo"].settings))


def test_plugin_algorithm(tmp_path, monkeypatch):
    (tmp_path / "quiet_td3.py").write_text(PLUGIN)
    monkeypatch.setenv("LARE_PLUGINS", "quiet_td3")
    output = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, cwd=tmp_path)
    *texts, hyperparameters, is_equal = output.stdout.splitlines()
    assert any("quiet" in line and "a test" in line for line in texts)
    assert any("--quiet.shift FLOAT" in line for line in texts)
    assert "shift=0.25" in hyperparameters
    assert "batch_size=8" in hyperparameters
    assert is_equal == "True"
