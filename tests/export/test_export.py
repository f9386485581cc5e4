"""Exported functions, as ONNX and as NumPy arrays, agree with JAX to the precision of float32."""

import errno
import importlib.util
import json
import subprocess
import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

import lare_rl
from helpers.jax_toy_envs import echo_spec
from helpers.long_tests import long_case
from helpers.small_configs import ONE_TEAM, TOTAL, TWO_TEAMS, random_steps, small_config, untrained_learner
from helpers.toy_envs import pick_spec, toy_spec
from helpers.training_runs import QUICK_CREDIT
from lare_rl.algorithms.ppo import ppo
from lare_rl.credit import decoder_state
from lare_rl.credit.methods import METHODS
from lare_rl.data import replay
from lare_rl.envs.interface import to_env_action
from lare_rl.envs.load import read_task
from lare_rl.export import export as export_module
from lare_rl.export.policy_graph import policy_graph
from lare_rl.export.reward_graph import _StepInputs
from lare_rl.export.translate import finish
from lare_rl.latent.function import LatentFunction, verify_function
from lare_rl.phi.builder import Builder, building
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.limits import UNLIMITED
from lare_rl.training import learner as learners
from lare_rl.training.policy import compile_policy, get_actor, init_memory, policy_input
from lare_rl.training.rewards import rewards
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed

LONG_CASES = {
    "td3": ("lare-bayes", "lare-signs", "diaster", "rudder", "lrr", "grd", "rbt"),
    "ddpg": ("rrdu",),
    "sac": ("vib-rrdu", "dense"),
    "ppo": ("bayes", "llm-reward", "rrdu-next"),
    "ippo": ("lare-bayes", "lare-rd-shared"),
    "ippo-teams": ("lare-rd",),
    "ippo-state": ("rrdu-next",),
    "qmix": ("lare-bayes",),
    "vdn": ("ircr",),
}
CASES = [("ppo", "lare-linear"), *(long_case(kind, method) for kind in LONG_CASES for method in LONG_CASES[kind])]
"""Every kind of policy, of decoder and of decoder input."""

NO_REWARD = {"dense": "rewards of the environment", "ircr": "return of its episode"}
"""Why there is no reward function."""

PHI = "def evaluation_func(o, a):\n    return [o[:, 0:1] * np.sum(a, axis=1, keepdims=True), o[:, 1:2]]\n"
MEDIAN = PHI.replace("np.sum(a", "np.median(a")


def make_task(kind, method):
    match kind:
        case "ppo":
            return pick_spec(scored_observation="after" if method == "llm-reward" else "both")
        case "td3" | "ddpg" | "sac":
            return toy_spec(scored_observation="both" if method == "lare-signs" else "before")
        case "ippo-teams":
            return read_task("CompetitivePP-6")
        case "ippo-state":
            return echo_spec(credit_scope="state", observation_size=9, action_size=9)
    return echo_spec()


@pytest.fixture(scope="module")
def export_run(small, small_many, tmp_path_factory):
    """Return a function that trains two seeds for a moment, and exports the second one: the run, and what was exported."""

    @cache
    def train_and_export(kind, method):
        single = kind in ("td3", "ddpg", "sac", "ppo")
        task, phi_kind = make_task(kind, method), METHODS[method].phi_kind
        source = MEDIAN if "ppo" in kind else PHI
        source = source.replace(", o[:, 1:2]", "") if phi_kind == "reward" else source
        function = None
        if METHODS[method].needs_phi:
            functions = [verify_function(source, role, phi_kind) for role in task.roles]
            function = functions if len(functions) > 1 else functions[0]
        values = {"method": method, "algorithm": kind.partition("-")[0]}
        values |= {"steps": 120, "capacity": 240} if single else {"steps": 200}
        # The lengths of the toy with many agents differ, so that the type of the score can be found.
        settings = small(**values) if single else small_many(**values, credit=QUICK_CREDIT | {"score": "auto"})
        directory = tmp_path_factory.mktemp("export")
        run = lare_rl.train(task, settings, function=function, out=directory / "run", listeners=[])
        result = lare_rl.export_run(run, directory / "out", seed=1)
        return run, result, import_exported(directory / "out")

    return train_and_export


def import_exported(directory):
    """Import the file `exported.py` of a directory, as its users do."""
    spec = importlib.util.spec_from_file_location("exported", directory / "exported.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def describe(exported, name):
    return json.loads((Path(exported.__file__).parent / "export.json").read_text())[name]


def check_function(exported, name, inputs, expected):
    """Both forms of a function give the expected outputs."""
    description, directory = describe(exported, name), Path(exported.__file__).parent
    arrays = {key: np.asarray(inputs[key], spec["type"]) for key, spec in description["inputs"].items()}
    for key, spec in description["inputs"].items():
        assert arrays[key].shape == (len(arrays[key]), *spec["shape"][1:])
    numpy_outputs = exported.load(name)(**arrays)
    row_outputs = exported.load(name)(**{key: rows[0] for key, rows in arrays.items()})
    session = onnxruntime.InferenceSession(directory / f"{name}.onnx", providers=["CPUExecutionProvider"])
    onnx_outputs = dict(zip(description["outputs"], session.run(None, arrays), strict=True))
    for key, spec in description["outputs"].items():
        np.testing.assert_allclose(row_outputs[key], numpy_outputs[key][0], rtol=1e-5, atol=1e-6)
        for output in (numpy_outputs[key], onnx_outputs[key]):
            assert output.shape == (len(output), *spec["shape"][1:])
            assert output.dtype == spec["type"]
            np.testing.assert_allclose(output, expected[key], rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize(("kind", "method"), CASES)
def test_export_agrees_with_jax(kind, method, export_run):
    run, result, exported = export_run(kind, method)
    config, learner, host, _ = load_learner(run)
    seed_learner = select_seed(learner, 1)
    actors = get_actor(learner.algorithm, host["step"], config)
    check_function(exported, "policy", *policy_case(config, jax.tree.map(lambda leaf: leaf[1:], actors)))
    names = [name for name in result.functions if name != "policy"]
    if result.no_reward_reason:
        assert NO_REWARD[method] in result.no_reward_reason
        assert names == []
        return
    # Random steps, because a replay may hold only the factors of its steps.
    steps = random_steps(config.env, config.n_envs)
    buffer = jax.jit(partial(learners.store, config=config, phi=run.graphs))(seed_learner, steps)[0].replay
    stored = jax.tree.map(jnp.concatenate, replay.read_newest(buffer, TOTAL))
    steps = jax.tree.map(lambda leaf: np.concatenate(np.swapaxes(leaf, 0, 1)), steps)
    # Exported rewards are in the unit of the true rewards, before they are scaled.
    unscaled = replace(config, scale_rewards=False)
    expected = np.asarray(rewards(stored, seed_learner.decoders, unscaled))
    for team_index, name in enumerate(names):
        check_reward(exported, name, config, steps, np.asarray(stored.length, np.float32), expected, team_index)


@pytest.mark.parametrize(("algorithm", "env"), [("qmix", replace(ONE_TEAM, first_choice=1)), ("ippo", TWO_TEAMS)])
def test_policy_graph_of_teams(algorithm, env):
    """The policies of teams, untrained: recurrent networks, and networks that read the index of the agent."""
    config = small_config("ircr", algorithm, env)
    learner = jax.tree.map(lambda leaf: leaf[None], untrained_learner(config))
    actor = get_actor(learner.algorithm, 0, config)
    if algorithm == "ippo":
        statistics = jax.tree.map(
            lambda leaf: leaf + jnp.linspace(1, 2, leaf.size).reshape(leaf.shape), actor.observation_rms
        )
        actor = actor._replace(observation_rms=statistics)
    inputs, expected = policy_case(config, actor)
    outputs = evaluate(policy_graph(jax.tree.map(lambda leaf: leaf[0], actor), config), inputs)
    assert outputs.keys() == expected.keys()
    for name, values in outputs.items():
        np.testing.assert_allclose(values, expected[name], rtol=2e-5, atol=2e-5)


def test_phi_of_a_team_reads_the_actions_of_its_agents():
    """With the credit scope "state", decoders read the actions of all agents."""
    config = small_config(
        "lare-linear", "ippo", replace(TWO_TEAMS, state_size=2), n_factors=(1, 1), credit_scope="state"
    )
    source = PHI.replace(", o[:, 1:2]", "")
    for index, agents in enumerate((slice(0, 3), slice(3, 5))):
        phi = LatentFunction("toy", "factors", source, 1, (), (2, 4 * (agents.stop - agents.start)))
        with building(Builder(UNLIMITED)):
            graph = finish(factors=_StepInputs(config, (), index, phi)["factors"])
        action = np.arange(20.0)[None]
        outputs = evaluate(graph, {"after": np.array([[2.0, 0.0]]), "action": action})
        assert outputs["factors"].item() == 2 * action.reshape(5, 4)[agents].sum()


def policy_case(config, actor):
    """Return inputs of a policy, and the outputs by JAX."""
    env, random = config.env, np.random.default_rng(0)
    rows = (3, env.n_agents)
    observation = random.normal(size=(*rows, env.observation_size)).astype(np.float32)
    available = np.ones((*rows, env.action_size), bool)
    if env.masks_actions:
        available = random.uniform(size=available.shape) < 0.5
        available[..., 0] = True
    memory, expected = init_memory(config, 1, 3), {}
    inputs = {"observation": observation, "available": available}
    if memory:
        hidden = random.normal(size=memory.hidden.shape).astype(np.float32)
        last = random.integers(env.action_size, size=rows)
        last[0] = env.action_size  # there was no action before the first step
        memory = memory._replace(
            hidden=jnp.asarray(hidden),
            last_action=jnp.asarray(np.eye(env.action_size + 1, env.action_size)[last])[None],
        )
        inputs |= {"hidden": hidden[0], "last_action": last + env.first_choice}
    is_new = jnp.zeros((1, 3), bool)
    action, memory = compile_policy(config, deterministic=True)(
        actor, memory, observation[None], available[None], None, is_new
    )
    if memory:
        expected["next_hidden"] = memory.hidden[0]
    if env.discrete and config.algorithm.name in ("ppo", "ippo"):
        rows = policy_input(jnp.asarray(observation)[None], config)
        expected["logits"] = np.asarray(jax.vmap(ppo.logits)(actor, rows, available[None]))[0]
    action = np.asarray(action)[0]
    expected["action"] = np.argmax(action, axis=-1) + env.first_choice if env.discrete else to_env_action(action, env)
    if env.n_agents == 1:
        inputs = {name: rows[:, 0] for name, rows in inputs.items()}
        expected = {name: rows[:, 0] for name, rows in expected.items()}
    return inputs, expected


def check_reward(exported, name, config, steps, length, expected, team_index):
    env, team = config.env, config.env.teams[team_index]
    inputs = {"length": length, "alive": steps.timestep.alive, "action": steps.env_action}
    for side, timestep in (("before", steps.timestep), ("after", steps.next_timestep)):
        inputs[side] = timestep.state if config.team_level else timestep.observation
    if config.team_level:
        inputs["action"] = inputs["action"].reshape(len(length), -1)
        expected = expected[:, 0]
    else:
        inputs = {key: rows[:, team.agents] if rows.ndim > 1 else rows for key, rows in inputs.items()}
        expected = expected[:, team.agents]
        if team.n_agents == 1:
            inputs = {key: rows[:, 0] if rows.ndim > 1 else rows for key, rows in inputs.items()}
            expected = expected[:, 0]
        else:
            inputs["length"] = inputs["length"][:, None]
    if config.env.agents_leave:  # the trainer gives agents that have left no reward
        arrays = {key: inputs[key] for key in describe(exported, name)["inputs"]}
        alive = steps.timestep.alive[:, 0] if config.team_level else steps.timestep.alive[:, team.agents]
        expected = np.where(alive, expected, exported.load(name)(**arrays)["r_hat"])
    check_function(exported, name, inputs, {"r_hat": expected})
    if env.discrete and not config.team_level:
        check_choice_numbers(exported, name, inputs, env.action_size)


def check_choice_numbers(exported, name, inputs, n_choices):
    """A choice can be a one-hot row or a number."""
    options = {key: inputs[key] for key in ("length", "alive") if key in describe(exported, name)["inputs"]}
    steps = {key: inputs[key] for key in ("before", "action", "after")}
    number = np.argmax(steps["action"], axis=-1)
    r_hat = exported.reward(**{**steps, "action": number}, name=name, **options)
    np.testing.assert_array_equal(r_hat, exported.reward(**steps, name=name, **options))
    for invalid in (number - n_choices, number + 0.5):
        with pytest.raises(ValueError, match=f"from 0 to {n_choices - 1}"):
            exported.reward(**{**steps, "action": invalid}, name=name, **options)


WITHOUT_LARE = """
import sys
import numpy as np
sys.modules |= {"lare_rl": None, "jax": None}
import exported
steps = np.load("steps.npz")
print(repr(exported.reward(**steps).tolist()))
"""


@pytest.fixture(scope="module")
def export(export_run):
    """Return a run of a single agent, and its exported functions."""
    run, _, exported = export_run("td3", "lare-bayes")
    return run, exported


@pytest.mark.long
def test_functions_without_lare(export):
    run, exported = export
    directory, rng = Path(exported.__file__).parent, np.random.default_rng(0)
    before, after = rng.uniform(-1, 1, (2, 5, 2)).astype(np.float32)
    action = rng.uniform(-2, 2, (5, 1)).astype(np.float32)
    np.savez(directory / "steps.npz", before=before, action=action, after=after)
    process = subprocess.run(
        [sys.executable, "-c", WITHOUT_LARE], cwd=directory, capture_output=True, text=True, check=True
    )
    config, learner, _, _ = load_learner(run)
    # Actions of the toy are in [-2, 2], and those of the trainer in [-1, 1].
    features = np.concatenate([run.functions[0](before, action), before, action / 2], axis=1)
    expected = decoder_state.decoder_rewards(
        select_seed(learner, 1).decoders[0], jnp.asarray(features), config.credit_specs[0]
    )
    np.testing.assert_allclose(json.loads(process.stdout), expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(exported.reward(before[0], action[0], after[0]), expected[0], rtol=1e-4)
    assert np.std(expected) > 0
    assert set(describe(exported, "reward")["inputs"]) == {"before", "action"}
    policy = lare_rl.load_policy(run, seed=1)
    outputs = exported.load("policy")(observation=before)["action"]
    np.testing.assert_allclose(outputs, [policy(row) for row in before], rtol=1e-5)


def test_command(export, command, monkeypatch, tmp_path):
    run, _ = export

    def fail(graph, name):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(export_module, "onnx_model", fail)
        assert "first cannot be written: No space left" in command("export", run.directory, "--out", "first")[2]
    status, out, err = command("export", run.directory, "--out", "first")
    assert (status, err) == (0, "")
    assert out.startswith("wrote policy, reward to first; exported.py")
    monkeypatch.setitem(sys.modules, "onnx", None)
    status, _, err = command("export", run.directory, "--out", "second")
    assert (status, err.count("\n")) == (0, 1)
    assert "[onnx]" in err
    assert not list((tmp_path / "second").glob("*.onnx"))
    for options, words in ((["second"], "second exists"), (["third", "--seed", "7"], "no seed 7")):
        status, _, err = command("export", run.directory, "--out", *options)
        assert (status, err.count("\n")) == (2, 1)
        assert words in err


def test_invalid_inputs(export):
    _, exported = export
    policy, rows = exported.load("policy"), np.zeros((4, 2))
    for call, message in (
        (lambda: exported.load("nope"), "'nope', only policy, reward"),
        (lambda: policy(obs=rows), "observation is missing"),
        (lambda: policy(observation=rows, obs=rows), "there is no input obs"),
        (lambda: policy(observation=np.zeros((5, 3))), r"\(batch, 2\).*\(5, 3\)"),
        (lambda: exported.reward(rows, 0.5, rows), r"action .*\(batch, 1\)"),
        (lambda: exported.reward(rows, np.zeros((3, 1)), rows), r"same batch.*before \(4,\), action \(3,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    r_hat = exported.reward(rows, np.zeros(1), rows)  # a single action for all steps
    np.testing.assert_array_equal(r_hat, exported.reward(rows, np.zeros((4, 1)), rows))


def test_trained_example_has_the_exported_programs():
    root = Path(__file__).parents[2]
    example, package = root / "examples" / "trained" / "HalfCheetah-v4", root / "src" / "lare_rl"
    for path in (package / "export" / "exported.py", package / "phi" / "evaluate.py"):
        assert (example / path.name).read_bytes() == path.read_bytes(), "export the example again"
