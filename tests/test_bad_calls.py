"""Calls that cannot work: each is a `LareError` of one line that says how to mend it.

They are made in a process of its own, without the type checker of the tests, as a user's program would make them.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SETUP = """
import json, sys
import numpy as np
import lare_rl
from lare_rl.errors import LareError
from lare_rl.latent.function import verified
from helpers.toys import PHI, pick_spec, toy_spec
task = toy_spec()
phi = verified(PHI, task)
tiny = dict(method="dense", steps=60, rollout_steps=12, evaluate_every=60, evaluation_episodes=1)
td3 = {"hidden": (8,), "batch_size": 8, "warmup": 36}
run = lare_rl.train(task, lare_rl.Settings(**tiny, td3=td3), out="run", listeners=[])
policy = lare_rl.policy_of("run")
listening = lambda *_: None
for call in json.load(sys.stdin):
    try:
        said = repr(eval(call))
    except LareError as error:
        said = str(error)
    except Exception as error:
        said = f"NOT A LareError: {type(error).__name__}: {error}"
    print(json.dumps(said))
"""

LISTENER = "a listener must have the methods started, stepped, evaluated, said and stopped (lare_rl.training.progress.Listener): "
TASK = "a task is a shipped name, the path of a task file, or a lare_rl.TaskSpec; it is "
POLICY = "an observation is 2 numbers, and a batch has rows of them: "
CALLS = {
    "lare_rl.train(task, {'method': 'rrdu'})": "settings must be a lare_rl.Settings, such as "
    "lare_rl.Settings(method='rrdu', steps=100_000), and are {'method': 'rrdu'}",
    "lare_rl.train(7)": f"{TASK}7",
    "lare_rl.train({'name': 'x'})": f"{TASK}{{'name': 'x'}}",
    "lare_rl.train(task, function=7)": "a latent function must be the path of its file, or come from lare_rl.design or "
    "lare_rl.load_function, and is 7: write its source to a file, which is verified",
    "lare_rl.train(task, listeners=[7])": f"{LISTENER}7 does not",
    "lare_rl.train(task, function='none.py')": "the function file none.py does not exist",
    "lare_rl.resume(7)": "a run must be a directory, or come from lare_rl.train or lare_rl.open_run, and is 7",
    "lare_rl.resume('none')": "none is not a run: there is no config.json in it",
    "lare_rl.evaluate_run(7)": "a run must be a directory, or come from lare_rl.train or lare_rl.open_run, and is 7",
    "lare_rl.evaluate_run('run', 1.5)": "episodes = 1.5: a whole number, 1 or more",
    "lare_rl.policy_of('none')": "none is not a run: there is no config.json in it",
    "lare_rl.policy_of(run, 7)": "run has no seed 7; its seeds: 0",
    "lare_rl.stored_episodes('none')": "none is not a run: there is no config.json in it",
    "lare_rl.stored_episodes(run, 7)": "run has no seed 7; its seeds: 0",
    "policy([1, 2, 3])": f"{POLICY}the shape is (3,)",
    "policy('left')": "an observation is 2 numbers: no array can be made of str",
    "policy(np.zeros((0, 2)))": f"{POLICY}the shape is (0, 2)",
    "lare_rl.export('none', 'out')": "none is not a run: there is no config.json in it",
    "lare_rl.write_report([])": "say which runs: no run is given",
    "lare_rl.load_function('none.py', task)": "the function file none.py does not exist",
    "lare_rl.load_function(listening.__code__.co_argcount, task)": "a latent function is read from the path of a file, not from 0",
    "lare_rl.load_function('none.py', 7)": "the function file none.py does not exist",
    "lare_rl.design(7)": f"{TASK}7",
    "lare_rl.design(task, model='gpt')": "a model must have a name and a method reply(messages, sample): 'gpt' does not",
    "lare_rl.reflect(phi, 7, None)": f"{TASK}7",
    "phi([[0, 0]] * 5, [[0]] * 4)": "there are 5 observations and 4 actions: each step needs one observation and one action",
    "phi([0, 0, 0], [0])": "observations must have the shape (batch, 2), or (2,) for a single step: the shape is (3,)",
    "phi([[0, 0]], 'left')": "actions must be arrays of numbers: 'left' cannot be converted to one",
    "phi([[0, 0]], [[0, 0]])": "actions must have the shape (batch, 1), or (1,) for a single step: the shape is (1, 2)",
    "phi(0, 0)": "observations must have the shape (batch, 2), or (2,) for a single step: the shape is ()",
    "lare_rl.CreditAssigner('lare-bayes', 7, task=task)": "phi must be a function from lare_rl.design or lare_rl.load_function, and is 7",
    "lare_rl.CreditAssigner('lare-bayes', phi, task=7)": f"{TASK}7",
    "lare_rl.CreditAssigner('lare-bayes', phi, task=pick_spec())": "the latent function was written for the task 'Chase', and this is "
    "'Pick': choose another one or, if this one is right for both, say so by dataclasses.replace(function, task='Pick')",
    "lare_rl.relabel('none', 'out', task=7)": f"{TASK}7",
    "lare_rl.logged_steps('none', 7)": f"{TASK}7",
}  # fmt: skip
FINE = {
    "phi([0.5, 0], [0.5]).shape": "(2,)",
    "phi([[0.5, 0]] * 3, [[0.5]] * 3).shape": "(3, 2)",
    "policy([0.5, 0]).shape": "(1,)",
    "policy([[0.5, 0]] * 3).shape": "(3, 1)",
    "bool(np.allclose(policy([[0.5, 0], [0, 1]])[1], policy([0, 1]), rtol=1e-5))": "True",
    "lare_rl.evaluate_run('run', 2)['Chase'].shape": "(1, 2)",
    "lare_rl.write_report('run').name": "'report.html'",
    "lare_rl.write_report(run).name": "'report.html'",
}


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """What each call says."""
    calls = [*CALLS, *FINE]
    done = subprocess.run(
        [sys.executable, "-c", SETUP],
        input=json.dumps(calls),
        capture_output=True,
        text=True,
        cwd=tmp_path_factory.mktemp("calls"),
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
    )
    assert done.returncode == 0, done.stderr
    return dict(zip(calls, map(json.loads, done.stdout.splitlines()[-len(calls) :]), strict=True))


@pytest.mark.parametrize("call", CALLS)
def test_a_bad_call_is_one_line(call, said):
    assert said[call] == CALLS[call]


@pytest.mark.parametrize("call", FINE)
def test_a_call_that_is_fine(call, said):
    assert said[call] == FINE[call]
