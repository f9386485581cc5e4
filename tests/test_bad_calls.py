"""Bad calls of public functions: each raises a `LareError` of one line.

They run in another process, without the type checker of the tests and without the libraries of extras. Its run is trained by an
algorithm from outside.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

PLUGIN = """
from dataclasses import replace
from lare_rl.algorithms.registry import ALGORITHMS, register_algorithm
from lare_rl.algorithms.td3.td3 import TD3Settings, act, get_actor, init, update

class QuietSettings(TD3Settings):
    shift: float = 0.5

def explore(actor, observation, noise, settings):
    return act(actor, observation) * settings.shift

settings = QuietSettings(hidden=(8,), batch_size=8, warmup=36)
register_algorithm(replace(ALGORITHMS["td3"], name="quiet", settings=settings, module=__name__, summary="a test"))
"""
SETUP = """
import contextlib, io, json, sys
class NoExtras:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in ("mujoco", "matplotlib", "PIL", "imageio", "torch", "openai", "pettingzoo"):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, NoExtras)
import numpy as np
import lare_rl, lare_rl.cli, lare_rl.cli.design, lare_rl.cli.runs, lare_rl.evaluation.video
from lare_rl.credit.decoders import Decoder
from lare_rl.credit.input_names import InputNames
from lare_rl.credit.methods import Fit, Method
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from helpers.toy_envs import PHI, pick_spec, toy_spec
task = toy_spec(measures=("distance",))
phi = verify_function(PHI, task)
tiny = dict(method="dense", steps=60, rollout_steps=12, evaluate_every=60, evaluation_episodes=1, seeds=2, capacity=64)
run = lare_rl.train(task, lare_rl.Settings(algorithm="quiet", quiet={"shift": 0.25}, **tiny), out="run", listeners=[])
policy = lare_rl.load_policy("run")
sizes = dict(action_size=1, n_envs=2, n_steps=4, max_steps=4)
credit = lare_rl.CreditAssigner("ircr", observation_space=3, action_space=1)
steps = credit.add_episode(np.ones((5, 3)), np.ones((5, 1)), np.ones((5, 3)), reward=1.0)
def command(*arguments):
    sys.argv[1:] = arguments
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()) as out:
        lare_rl.cli.main()
    return " ".join(out.getvalue().split())
for call in json.load(sys.stdin):
    try:
        result = repr(eval(call))
    except LareError as error:
        result = str(error)
    except Exception as error:
        result = f"NOT A LareError: {type(error).__name__}: {error}"
    print(json.dumps(result))
"""

CALLS = {
    "lare_rl.train(task, {'method': 'rrdu'})": "lare_rl.Settings",
    "lare_rl.train(7)": "TaskSpec",
    "lare_rl.train({'name': 'x'})": "TaskSpec",
    "lare_rl.train(task, function=7)": "lare_rl.load_function",
    "lare_rl.train(task, function=[None])": "lare_rl.load_function",
    "lare_rl.train(task, listeners=[7])": "lare_rl.training.progress.Listener",
    "lare_rl.train(task, listeners=[lare_rl.training.progress.Terminal])": "lare_rl.training.progress.Listener",
    "lare_rl.train(task, listeners=7)": "a list, and are 7",
    "lare_rl.train(task, function='none.py')": "none.py does not exist",
    "lare_rl.resume(7)": "lare_rl.open_run",
    "lare_rl.resume('none')": "none is not a run",
    "lare_rl.resume('run', steps='many')": "steps = 'many'",
    "lare_rl.evaluate_run(7)": "lare_rl.open_run",
    "lare_rl.evaluate_run('run', 1.5)": "episodes = 1.5",
    "lare_rl.load_policy('none')": "none is not a run",
    "lare_rl.stored_episodes('none')": "none is not a run",
    "policy([1, 2, 3])": "(3,)",
    "policy('left')": "'left'",
    "policy(np.zeros((0, 2)))": "the batch is empty",
    "policy.select_env_action([[0, 0]])": "of shape (2,), and was given an array of shape (1, 2)",
    "lare_rl.export_run('none', 'out')": "none is not a run",
    "lare_rl.design(task, 'rewards')": "'rewards': it is factors or reward",
    "lare_rl.design(task, candidates=2.5)": "candidates = 2.5",
    "verify_function(PHI, task, 'rewards')": "'rewards': it is factors or reward",
    "lare_rl.design(task, steps=7)": "two arrays",
    "lare_rl.design(task, steps=(7, 7))": "the shape (n, 2)",
    "lare_rl.design(task, steps=([[1, 2], [3]], [[1]]))": "arrays of numbers",
    "lare_rl.load_function('none.py', task)": "none.py does not exist",
    "lare_rl.load_function(0, task)": "not from 0",
    "lare_rl.load_function('none.py', 7)": "none.py does not exist",
    "lare_rl.design(7)": "TaskSpec",
    "lare_rl.design(task, model='gpt')": "reply(messages, number)",
    "lare_rl.reflect(phi, 7, None)": "TaskSpec",
    "lare_rl.reflect(phi, task, lambda messages, number: '', 1.5)": "rounds = 1.5",
    "lare_rl.pure_credit('bayes', observation_size='2', **sizes)": "observation_size = '2'",
    "lare_rl.pure_credit('rrdu', observation_size=2, fit_updates=-1, **sizes)": "fit_updates = -1",
    "lare_rl.pure_credit('bayes', observation_size=2, scored_observation='now', **sizes)": "'before', 'after' or 'both'",
    "lare_rl.pure_credit('bayes', observation_size=2, settings={'score': 'sum'}, **sizes)": "lare_rl.CreditSettings",
    "lare_rl.pure_credit('lare-bayes', 'phi.py', observation_size=2, **sizes)": "lare_rl.load_function",
    "phi([[0, 0]] * 5, [[0]] * 4)": "the same batch axes: their shapes are (5, 2) and (4, 1)",
    "phi([0, 0, 0], [0])": "(*batch, 2)",
    "phi(np.zeros((3, 2), complex), [[0]] * 3)": "observations must be arrays of numbers",
    "phi([[0, 0]], 'left')": "'left'",
    "phi([[0, 0]], [[0, 0]])": "(*batch, 1)",
    "phi(0, 0)": "(*batch, 2)",
    "phi.step_factors(np.zeros((2, 3, 2)), np.zeros((3, 2, 1)), np.zeros((2, 3, 2)), 'both')": "the same batch axes",
    "phi.step_factors([0, 0], [0], None, 'after')": "(*batch, 2)",
    "phi.step_factors([0, 0], [0], [0, 0], 'now')": "before, after or both",
    "lare_rl.CreditAssigner('lare-bayes', 7, task=task)": "lare_rl.load_function",
    "lare_rl.CreditAssigner('lare-bayes', phi, task=7)": "TaskSpec",
    "lare_rl.CreditAssigner('lare-bayes', phi, task=pick_spec())": "task='Pick'",
    "credit.fit(2.5)": "updates = 2.5",
    "lare_rl.relabel('none', 'out', updates=2.5)": "updates = 2.5",
    "lare_rl.relabel('none', 'out', task=7)": "TaskSpec",
    "lare_rl.logged_steps('none', 7)": "TaskSpec",
    "lare_rl.logged_steps('none', task, 0)": "count = 0",
    "lare_rl.relabel('none', 'out', hold_out='0.1')": "hold_out = '0.1'",
    "lare_rl.relabel('none', 'out', memory='1')": "memory = '1'",
    "lare_rl.CreditAssigner(3)": "no method 3",
    "Method('mine', '', '', inputs=('observation',))": "method mine: ('observation',) is no InputNames: write",
    "Method('mine', '', '', fit='all steps')": "method mine: 'all steps' is no Fit: write Fit.ALL_STEPS",
    "Method('mine', '', '', decoder=None)": "None is no str: write",
    "InputNames('action')": "a tuple of names",
    "InputNames(5)": "a tuple of names",
    "InputNames(())": "a tuple of names",
    "InputNames(('action',), ())": "a tuple of names",
    "Decoder('mine', 'mine:init', settings='hidden')": "a set of names",
    "Decoder('mine', 'mine:init', settings=5)": "a set of names",
}
"""Bad calls, and what the message must contain."""

GOOD_CALLS = {
    "lare_rl.TurnCredit(np.float32(0.5)).lambda_ == 0.5": "True",
    "phi([0.5, 0], [0.5]).shape": "(2,)",
    "InputNames(['action']).names": "('action',)",
    "InputNames(('next_observation', 'scored_observation')).resolve('after')": "('next_observation',)",
    "phi([[0.5, 0]] * 3, [[0.5]] * 3).shape": "(3, 2)",
    "policy([0.5, 0]).shape": "(1,)",
    "policy([[0.5, 0]] * 3).shape": "(3, 1)",
    "bool(np.allclose(policy([[0.5, 0], [0, 1]])[1], policy([0, 1]), rtol=1e-5))": "True",
    "lare_rl.evaluate_run('run', 2)['Chase'].shape": "(2, 2)",
    "lare_rl.load_task('CN-6').name": "CN-6",
    "credit.rewards_at(steps).shape": "(5,)",
    "run.config.settings.hyperparameters": "batch_size=8, ",
    "run.config.settings.hyperparameters.shift": "0.25",
    "lare_rl.open_run('run').config.settings == run.config.settings": "True",
    "'a test' in command('algorithms')": "True",
    "'--quiet.shift FLOAT' in command('train', '--algorithm', 'quiet', '--help')": "True",
}


def test_calls(tmp_path):
    (tmp_path / "quiet_td3.py").write_text(PLUGIN)
    paths = os.pathsep.join([str(tmp_path), str(Path(__file__).parent), *sys.path])
    calls = CALLS | GOOD_CALLS
    process = subprocess.run(
        [sys.executable, "-c", SETUP],
        input=json.dumps(list(calls)),
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": paths, "LARE_PLUGINS": "quiet_td3"},
    )
    assert process.returncode == 0, process.stderr
    results = dict(zip(calls, map(json.loads, process.stdout.splitlines()[-len(calls) :]), strict=True))
    for call, words in calls.items():
        assert words in results[call], call
        assert "NOT A LareError" not in results[call], call
        assert "\n" not in results[call], call
