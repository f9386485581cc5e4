"""From recorded replies to a report on a system without the modules, functions, signals and folders that only POSIX has."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import lare_rl
from lare_rl.sweep.sweep import read_sweep

PROGRAM = """
import sys
from lare_rl.cli import main
for command in sys.argv[1:]:
    sys.argv = ["lare-rl", *command.split()]
    try:
        main()
    except SystemExit as exit:
        raise SystemExit(f"{command}: status {exit.code}") from exit
from lare_rl.util.float64 import float64
with float64():  # limits the threads of linear algebra, as a fit in closed form does
    pass
"""
PHI = """
    def evaluation_func(observation, action):
        return [observation[:, :1] - action[:, :1] ** 2]
"""
TASK = """
    name = "Pendulum"
    environment = "Pendulum-v1"
    processes = "separate"
    observation_size = 3
    action_size = 1
    scored_observation = "after"
    description = "größe"
    observation = "x, y, speed"
    action = "torque"
"""
STUDY = """
    tasks = ["pendulum.toml"]
    methods = ["llm-reward"]
    functions = { Pendulum = ["phi.py"] }
    [settings]
    steps = 200
    environments = 2
    evaluate_every = 100
    evaluation_episodes = 1
    td3 = { warmup = 100, hidden = [8], batch_size = 8 }
"""
LOST = """
import ctypes, os, signal, sys
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    try:
        __import__(name)
    except ImportError:
        pass
    else:
        raise SystemExit(name)
assert not hasattr(os, "fork") and not hasattr(signal, "SIGKILL") and not os.path.isdir("/dev/shm")
for call, error in ((lambda: ctypes.CDLL(None), TypeError), (lambda: open("/proc/cpuinfo"), FileNotFoundError)):
    try:
        call()
    except error:
        continue
    raise SystemExit("the call worked")
with open("file", "w") as file:
    assert file.encoding.lower() not in ("utf-8", "utf8")
    try:
        os.replace("file", "other")
    except PermissionError:
        sys.exit()
raise SystemExit("an open file was moved")
"""


@pytest.fixture
def run_elsewhere(tmp_path):
    """Return a function that runs a Python program on the other system, in an empty folder."""
    folders = Path(__file__).parent / "helpers" / "other_system", Path(lare_rl.__file__).parents[1]
    environment = {
        "PYTHONPATH": os.pathsep.join(map(str, folders)),
        "PYTHONUTF8": "0",
        "PYTHONCOERCECLOCALE": "0",
        "LC_ALL": "C",
        "LARE_CACHE": "off",  # the lock of its folder is another one on Linux
    }

    def run(program, *arguments):
        process = subprocess.run(
            [sys.executable, "-c", program, *arguments],
            cwd=tmp_path,
            env=os.environ | environment,
            capture_output=True,
            encoding="utf-8",
        )
        assert process.returncode == 0, process.stdout + process.stderr
        return process.stdout

    return run


@pytest.fixture
def task(tmp_path):
    for name, text in (("phi.py", PHI), ("pendulum.toml", TASK), ("study.toml", STUDY)):
        (tmp_path / name).write_text(textwrap.dedent(text), encoding="utf-8")
    return tmp_path / "study.toml"


@pytest.mark.long
def test_task_and_function(run_elsewhere, task):
    run_elsewhere(LOST)
    run_elsewhere(PROGRAM, "new-task Pendulum-v1 --out new.toml", "verify phi.py --task pendulum.toml --kind reward")


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="this is the other system")
def test_study(run_elsewhere, task, tmp_path):
    """With a host environment in worker processes."""
    (job,) = read_sweep(task)[1]
    output = run_elsewhere(
        PROGRAM,
        "sweep study.toml",
        f"train --resume {job.directory} --steps 300",
        f"evaluate {job.directory} --episodes 2",
        f"report {job.directory}",
        f"compare {job.directory}",
        "design CN-6 --out cn.py",
    )
    assert "over 2 episodes" in output
    assert (job.directory / "report.html").stat().st_size > 10_000
    assert (tmp_path / "runs" / "study" / "results.csv").is_file()
