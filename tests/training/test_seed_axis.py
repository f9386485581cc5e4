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
from helpers.toy_envs import toy_spec
from helpers.training_runs import QUICK_CREDIT, resume_quietly, train_quietly
from lare_rl.training import seed_axis

ON_DEVICES = """
import json, re, sys
import helpers.jax_toy_envs, helpers.toy_envs
import lare_rl
from helpers.training_runs import train_and_stop
from lare_rl.runs.directory import open_run
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.session import restore_session

task, settings, function = TaskSpec(**json.loads(sys.argv[1])), lare_rl.Settings(**json.loads(sys.argv[2])), sys.argv[3]
train_and_stop(task, settings, "run", settings.evaluate_every, function or None)
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


def check_devices(expected_run, settings, tmp_path, n_devices):
    """Assert that a run on several devices, stopped there and resumed on a single one, has the metrics of a run on one."""
    function = expected_run.directory / "latent_function.py"
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={n_devices}"
    arguments = expected_run.config.task.model_dump_json(), settings.model_dump_json(exclude_unset=True)
    process = subprocess.run(
        [sys.executable, "-c", ON_DEVICES, *arguments, str(function) if function.exists() else ""],
        cwd=tmp_path,
        env=os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr
    assert json.loads(process.stdout) == {"devices": n_devices, "collectives": []}
    lines, expected_lines = map(metrics_without_times, (resume_quietly(tmp_path / "run"), expected_run))
    for line, expected in zip(lines, expected_lines, strict=True):
        assert line.keys() == expected.keys()
        assert read_numbers(line) == pytest.approx(read_numbers(expected), rel=1e-3, abs=1e-4, nan_ok=True)


def read_numbers(line):
    return [math.nan if value is None else value for _, value in sorted(line.items())]


@pytest.mark.long
def test_devices_train_as_a_single_device(echo_run, echo_settings, tmp_path):
    check_devices(echo_run, echo_settings, tmp_path, 2)


FEW = {"environments": 2, "rollout_steps": 10, "steps": 80, "evaluate_every": 40}
"""With fewer than 20 episodes, no explanation is compiled."""


@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "changes"),
    [
        (echo_spec(), {"algorithm": "ippo", "method": "rd-linear"} | FEW),
        (toy_spec(), {"algorithm": "td3", "method": "rrdu"}),
        ("CN-6", {"algorithm": "ippo", "method": "bayes"}),
        (echo_spec(), {"algorithm": "qmix", "method": "rd"}),
        (echo_spec(), {"algorithm": "ippo", "method": "rd", "first_fit": "held-out"}),
        (echo_spec(environment="hosted/three"), {"algorithm": "qmix", "method": "dense", "environments": 1}),
        (toy_spec(), {"algorithm": "sac", "method": "rrdu", "overlap_collection": True}),
    ],
)
def test_four_devices_train_as_a_single_device(task, changes, small, small_many, tmp_path):
    make_settings = small if changes["algorithm"] in ("td3", "sac") else small_many
    settings = make_settings(seeds=4, credit=QUICK_CREDIT, **changes)
    task = lare_rl.load_task(task) if isinstance(task, str) else task
    check_devices(train_quietly(task, settings, tmp_path / "expected"), settings, tmp_path, 4)


@pytest.mark.parametrize(("n_seeds", "n_devices", "count"), [(5, 1, 1), (4, 4, 4), (6, 4, 3), (5, 4, 1), (5, 8, 5)])
def test_count_seed_devices(n_seeds, n_devices, count, monkeypatch):
    monkeypatch.setattr(seed_axis.jax, "local_device_count", lambda: n_devices)
    assert seed_axis.count_seed_devices(n_seeds) == count
