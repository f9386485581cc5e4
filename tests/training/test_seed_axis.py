"""Seeds that are spread over several devices train as on a single device."""

import json
import math
import os
import subprocess
import sys

import pytest

import lare_rl
from helpers.jax_toy_envs import echo_spec
from helpers.listeners import metrics_without_times
from helpers.long_tests import long_case
from helpers.toy_envs import toy_spec
from helpers.training_runs import QUICK_CREDIT, resume_quietly, train_quietly
from lare_rl.training import seed_axis

N_DEVICES = 4
ON_DEVICES = """
import json, re, sys
import helpers.jax_toy_envs, helpers.toy_envs
import lare_rl
from helpers.training_runs import train_and_stop
from lare_rl.runs.directory import open_run
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.session import restore_session

task, settings = TaskSpec(**json.loads(sys.argv[1])), lare_rl.Settings(**json.loads(sys.argv[2]))
train_and_stop(task, settings, "run", settings.evaluate_every)
opened, _ = restore_session(open_run("run"))
functions = opened.functions
compiled = [functions.store, functions.train_step] if opened.loop is None else [opened.loop.args[0]]
collective = re.compile("all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter")
opened.close()
print(json.dumps({
    "devices": len(opened.learner.replay.row.sharding.device_set),
    "collectives": sorted({name for program in compiled for name in collective.findall(program.as_text())}),
}))
"""


FEW = {"environments": 2, "rollout_steps": 10, "steps": 80, "evaluate_every": 40}
"""With fewer than 20 episodes, no explanation is compiled."""


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        (echo_spec(), {"algorithm": "ippo", "method": "rd-linear"} | FEW),
        long_case(toy_spec(), {"algorithm": "td3", "method": "rrdu"}),
        long_case("CN-6", {"algorithm": "ippo", "method": "bayes"}),
        long_case(echo_spec(), {"algorithm": "qmix", "method": "rd"}),
        long_case(echo_spec(), {"algorithm": "ippo", "method": "rd", "first_fit": "held-out", "environments": 16}),
        long_case(echo_spec(environment="hosted/three"), {"algorithm": "qmix", "method": "dense", "environments": 1}),
        long_case(toy_spec(), {"algorithm": "sac", "method": "rrdu", "overlap_collection": True}),
    ],
)
def test_devices_train_as_a_single_device(task, changes, small, small_many, tmp_path):
    make_settings = small if changes["algorithm"] in ("td3", "sac") else small_many
    settings = make_settings(seeds=N_DEVICES, credit=QUICK_CREDIT, **changes)
    task = lare_rl.load_task(task) if isinstance(task, str) else task
    expected_run = train_quietly(task, settings, tmp_path / "expected")
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={N_DEVICES}"
    arguments = task.model_dump_json(), settings.model_dump_json(exclude_unset=True)
    process = subprocess.run(
        [sys.executable, "-c", ON_DEVICES, *arguments],
        cwd=tmp_path,
        env=os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr
    assert json.loads(process.stdout) == {"devices": N_DEVICES, "collectives": []}

    lines, expected_lines = map(metrics_without_times, (resume_quietly(tmp_path / "run"), expected_run))
    for line, expected in zip(lines, expected_lines, strict=True):
        assert line.keys() == expected.keys()
        assert read_numbers(line) == pytest.approx(read_numbers(expected), rel=1e-3, abs=1e-4, nan_ok=True)


def read_numbers(line):
    return [math.nan if value is None else value for value in line.values()]


@pytest.mark.parametrize(("n_seeds", "n_devices", "count"), [(5, 1, 1), (4, 4, 4), (6, 4, 3), (5, 4, 1), (5, 8, 5)])
def test_count_seed_devices(n_seeds, n_devices, count, monkeypatch):
    monkeypatch.setattr(seed_axis.jax, "local_device_count", lambda: n_devices)
    assert seed_axis.count_seed_devices(n_seeds) == count
