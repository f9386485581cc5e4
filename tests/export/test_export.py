"""What a run exports agrees with JAX to the precision of float32, as ONNX and as NumPy arrays."""

import importlib.util
import json
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

import lare_rl
from helpers.recipes import TOTAL, steps_of
from helpers.tiers import long
from helpers.toys import pick_spec, toy_spec
from lare_rl.algorithms import ppo
from lare_rl.credit import decomposition
from lare_rl.credit.methods import METHODS
from lare_rl.data import replay
from lare_rl.envs.interface import env_action
from lare_rl.envs.load import read_task
from lare_rl.errors import pip_install
from lare_rl.export import export
from lare_rl.latent.function import verified
from lare_rl.training import learner as common
from lare_rl.training import on_policy
from lare_rl.training.compiled import compiled, new_memory
from lare_rl.training.learner import Paid
from lare_rl.training.seed_axis import of_seed
from lare_rl.training.session import graphs, load_learner

CASES = [
    ("td3", "lare-bayes"),
    long("ddpg", "rrdu"),
    long("sac", "vib-rrdu"),
    long("td3", "lare-signs"),
    long("td3", "diaster"),
    long("sac", "dense"),
    ("ppo", "lare-linear"),
    long("ppo", "bayes"),
    long("ppo", "llm-reward"),
    long("ppo", "rrdu-next"),
    long("ippo", "lare-bayes"),
    long("ippo", "lare-rd-shared"),
    long("ippo-teams", "lare-rd"),
    long("ippo-state", "rrdu-next"),
    long("qmix", "lare-bayes"),
    long("vdn", "ircr"),
]
"""Every kind of policy, and every kind of decoder and of what it is given."""

LEFT_OUT = {
    "dense": "dense trains on what the environment pays",
    "ircr": "ircr pays by the return of a step's episode",
    "diaster": "diaster looks at whole episodes, not at steps",
}
"""Why there is no reward."""


def task_of(kind, method, echo):
    match kind:
        case "ppo":
            return pick_spec(judges="after" if method == "llm-reward" else "both")
        case "ippo" | "qmix" | "vdn":
            return echo
        case "ippo-state":
            return echo.model_copy(update={"judged_from": "state", "observation_size": 9, "action_size": 9})
        case "ippo-teams":
            return read_task("CompetitivePP-6")
        case _:
            return toy_spec(judges="both" if method == "lare-signs" else "before")


PHI = """import numpy as np

def evaluation_func(o, a):
    return [o[:, 0:1] * np.sum(a, axis=1, keepdims=True), o[:, 1:2]]
"""
MEDIAN = PHI.replace("np.sum(a", "np.median(a")


def trained(kind, method, small, small_many, echo, out):
    """A short run, of two seeds."""
    row, task, one = METHODS[method], task_of(kind, method, echo), kind in ("td3", "ddpg", "sac", "ppo")
    source = MEDIAN if "ppo" in kind else PHI
    source = source.replace(", o[:, 1:2]", "") if row.kind == "reward" else source
    function = None
    if row.latent:
        made = [verified(source, role, row.kind) for role in task.roles]
        function = made if len(made) > 1 else made[0]
    algorithm = kind.partition("-")[0]
    settings = (small if one else small_many)(method=method, algorithm=algorithm, steps=120 if one else 200)
    return lare_rl.train(task, settings, function=function, out=out, listeners=[])


def loaded(directory):
    """The file `exported.py` of a directory, as its users import it."""
    spec = importlib.util.spec_from_file_location("exported", directory / "exported.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def same(exported, name, inputs, wanted):
    """Both forms give what is wanted."""
    described = json.loads((exported.HERE / "export.json").read_text())[name]
    given = {key: np.asarray(inputs[key], one["type"]) for key, one in described["inputs"].items()}
    for key, one in described["inputs"].items():
        assert given[key].shape == (len(given[key]), *one["shape"][1:])
    of_numpy = exported.load(name)(**given)
    of_a_row = exported.load(name)(**{key: rows[0] for key, rows in given.items()})
    session = onnxruntime.InferenceSession(exported.HERE / f"{name}.onnx", providers=["CPUExecutionProvider"])
    of_onnx = dict(zip(described["outputs"], session.run(None, given), strict=True))
    for key, one in described["outputs"].items():
        np.testing.assert_allclose(of_a_row[key], of_numpy[key][0], rtol=1e-5, atol=1e-6)
        for found in (of_numpy[key], of_onnx[key]):
            assert found.shape == (len(found), *one["shape"][1:])
            assert found.dtype == one["type"]
            np.testing.assert_allclose(found, wanted[key], rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize(("kind", "method"), CASES)
def test_what_is_exported_agrees_with_jax(kind, method, small, small_many, echo, tmp_path):
    run = trained(kind, method, small, small_many, echo, tmp_path / "run")
    found = lare_rl.export(run, tmp_path / "out", seed=1)
    exported = loaded(tmp_path / "out")
    config, learner, host, _ = load_learner(run)
    one = of_seed(learner, 1)
    check_policy(exported, config, jax.tree.map(lambda leaf: leaf[1:], compiled(config).actor(learner, host["step"])))
    rewards = [name for name in found.functions if name != "policy"]
    if found.left_out:
        assert (found.left_out, rewards) == (LEFT_OUT[method], [])
        return
    # Random steps, because a replay may hold the factors of its steps alone.
    steps = steps_of(config.env, config.environments)
    buffer = jax.jit(partial(common.store, config=config, phi=graphs(run)))(one, steps)[0].replay
    stored = jax.tree.map(jnp.concatenate, replay.read(buffer, replay.newest(buffer, TOTAL)))
    steps = jax.tree.map(lambda leaf: np.concatenate(np.swapaxes(leaf, 0, 1)), steps)
    wanted = common.rewards(stored, Paid(one.credit, one.scale), config)
    if config.scale_rewards:
        scale = [np.full(team.size, common.magnitude(of)) for team, of in zip(config.env.teams, one.scale, strict=True)]
        wanted = wanted * np.concatenate(scale)
    for place, name in enumerate(rewards):
        check_reward(exported, name, config, steps, np.asarray(stored.length, np.float32), np.asarray(wanted), place)


def check_policy(exported, config, actor):
    env, random = config.env, np.random.default_rng(0)
    rows = (3, env.agents)
    observation = random.normal(size=(*rows, env.observation_size)).astype(np.float32)
    available = np.ones((*rows, env.action_size), bool)
    if env.masks_actions:
        available = random.uniform(size=available.shape) < 0.5
        available[..., 0] = True
    memory, wanted = new_memory(config, 1, 3), {}
    inputs = {"observation": observation, "available": available}
    if memory:
        hidden = random.normal(size=memory.hidden.shape).astype(np.float32)
        last = random.integers(env.action_size, size=rows)
        last[0] = env.action_size  # nothing was done before
        memory = memory._replace(
            hidden=jnp.asarray(hidden),
            last_action=jnp.asarray(np.eye(env.action_size + 1, env.action_size)[last])[None],
        )
        inputs |= {"hidden": hidden[0], "last_action": last}
    new = jnp.zeros((1, 3), bool)
    action, memory = compiled(config).act(actor, memory, observation[None], available[None], None, new)
    if memory:
        wanted["next_hidden"] = memory.hidden[0]
    if env.discrete and not config.greedy:
        shown = on_policy.policy_input(jnp.asarray(observation)[None], config)
        logits = jax.vmap(lambda one, *given: one.policy.logits(ppo.shown(given[0], one.observations), given[1]))
        wanted["logits"] = np.asarray(logits(actor, shown, available[None]))[0]
    action = np.asarray(action)[0]
    wanted["action"] = np.argmax(action, axis=-1) if env.discrete else env_action(action, env)
    if env.agents == 1:
        inputs = {name: rows[:, 0] for name, rows in inputs.items()}
        wanted = {name: rows[:, 0] for name, rows in wanted.items()}
    same(exported, "policy", inputs, wanted)


def check_reward(exported, name, config, steps, length, wanted, place):
    env, team = config.env, config.env.teams[place]
    inputs = {"length": length, "alive": steps.before.alive, "action": steps.taken}
    for side, timestep in (("before", steps.before), ("after", steps.after)):
        inputs[side] = timestep.state if config.of_state else timestep.observation
    if config.of_state:
        inputs["action"] = inputs["action"].reshape(len(length), -1)
        wanted = wanted[:, 0]
    else:
        inputs = {key: rows[:, team.agents] if rows.ndim > 1 else rows for key, rows in inputs.items()}
        wanted = wanted[:, team.agents]
        if team.size == 1:
            inputs = {key: rows[:, 0] if rows.ndim > 1 else rows for key, rows in inputs.items()}
            wanted = wanted[:, 0]
        else:
            inputs["length"] = inputs["length"][:, None]
    if config.env.agents_leave:  # the trainer pays those who have left nothing
        given = {key: inputs[key] for key in exported.described(name)["inputs"]}
        there = steps.before.alive[:, 0] if config.of_state else steps.before.alive[:, team.agents]
        wanted = np.where(there, wanted, exported.load(name)(**given)["r_hat"])
    same(exported, name, inputs, {"r_hat": wanted})
    if env.discrete and not config.of_state:
        of_numbers(exported, name, inputs, env.action_size)


def of_numbers(exported, name, inputs, count):
    """A choice may also be given as its number."""
    more = {key: inputs[key] for key in ("length", "alive") if key in exported.described(name)["inputs"]}
    steps = {key: inputs[key] for key in ("before", "action", "after")}
    number = np.argmax(steps["action"], axis=-1)
    found = exported.reward(**{**steps, "action": number}, name=name, **more)
    np.testing.assert_array_equal(found, exported.reward(**steps, name=name, **more))
    for wrong in (number - count, number + 0.5):
        with pytest.raises(ValueError, match=f"an action is a number from 0 to {count - 1}, or a one-hot row"):
            exported.reward(**{**steps, "action": wrong}, name=name, **more)


@pytest.fixture
def run(small, tmp_path, phi):
    return lare_rl.train(
        toy_spec(), small(method="lare-bayes", steps=120), function=phi, out=tmp_path / "run", listeners=[]
    )


WITHOUT_LARE = """
import sys
import numpy as np
sys.modules |= {"lare_rl": None, "jax": None}
import exported
steps = np.load("steps.npz")
print(repr(exported.reward(**steps).tolist()))
"""


def test_phi_and_decoder_are_one_function_without_lare(run, tmp_path, phi):
    lare_rl.export(run, tmp_path / "out")
    random = np.random.default_rng(0)
    before, after = random.uniform(-1, 1, (2, 5, 2)).astype(np.float32)
    action = random.uniform(-2, 2, (5, 1)).astype(np.float32)
    np.savez(tmp_path / "out" / "steps.npz", before=before, action=action, after=after)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_LARE], cwd=tmp_path / "out", capture_output=True, text=True, check=True
    )
    config, learner, _, _ = load_learner(run)
    # What the decoder sees: the toy's actions are from -2 to 2, the trainer's from -1 to 1.
    rows = np.concatenate([phi(before, action), before, action / 2], axis=1)
    wanted = decomposition.proxy_rewards(of_seed(learner).credit[0], jnp.asarray(rows), config.credit)
    np.testing.assert_allclose(json.loads(done.stdout), wanted, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(loaded(tmp_path / "out").reward(before[0], action[0], after[0]), wanted[0], rtol=1e-4)
    assert np.std(wanted) > 0
    assert set(loaded(tmp_path / "out").described("reward")["inputs"]) == {"before", "action"}


def test_the_policy_is_that_of_policy_of(run, tmp_path):
    lare_rl.export(run, tmp_path / "out", seed=1)
    observation = np.random.default_rng(0).uniform(-1, 1, (4, 2)).astype(np.float32)
    act = lare_rl.policy_of(run, seed=1)
    found = loaded(tmp_path / "out").load("policy")(observation=observation)["action"]
    np.testing.assert_allclose(found, [act(row) for row in observation], rtol=1e-5)


def test_the_command_line(run, command, monkeypatch, tmp_path):
    status, said, noted = command("export", run.directory, "--out", "first")
    assert (status, noted) == (0, "")
    assert said == "wrote policy, reward to first; exported.py there says how to call them\n"
    monkeypatch.setattr(export, "is_installed", lambda: False)
    status, _, noted = command("export", run.directory, "--out", "second")
    assert noted == f"without the package onnx, no .onnx files were written: {pip_install('onnx')}\n"
    assert not list((tmp_path / "second").glob("*.onnx"))
    status, _, noted = command("export", run.directory, "--out", "second")
    assert (status, noted) == (2, "lare-rl: second exists, and is not overwritten; choose another directory\n")
    status, _, noted = command("export", run.directory, "--out", "third", "--seed", "7")
    assert (status, noted) == (2, f"lare-rl: {run.directory} has no seed 7; its seeds: 0, 1\n")


def test_what_an_exported_function_is_not_given_is_named(run, tmp_path):
    lare_rl.export(run, tmp_path / "out")
    exported = loaded(tmp_path / "out")
    with pytest.raises(ValueError, match="there is no function 'nope', only policy, reward"):
        exported.load("nope")
    with pytest.raises(ValueError, match="policy needs the inputs observation: observation is missing"):
        exported.load("policy")(obs=np.zeros((1, 2)))
    with pytest.raises(ValueError, match="policy needs the inputs observation: there is no input obs"):
        exported.load("policy")(observation=np.zeros((1, 2)), obs=np.zeros((1, 2)))


def test_an_exported_function_refuses_arrays_of_other_sizes(run, tmp_path):
    lare_rl.export(run, tmp_path / "out")
    exported = loaded(tmp_path / "out")
    with pytest.raises(ValueError, match=r"^observation must have the shape \(batch, 2\), and has \(5, 3\)$"):
        exported.load("policy")(observation=np.zeros((5, 3)))
    with pytest.raises(ValueError, match=r"^action must have the shape \(batch, 1\), and has \(\)$"):
        exported.reward(np.zeros((1, 2)), 0.5, np.zeros((1, 2)))
