"""Whole runs of many agents: particle tasks, teams, a toy whose agents leave."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lare_rl
from helpers.jax_toy_envs import Echo
from helpers.small_configs import random_steps, small_config
from helpers.training_runs import ECHO_PHI, train_quietly
from lare_rl.config.resolve import resolve
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.runs.directory import create_run, open_run
from lare_rl.training import decoder_inputs
from lare_rl.training.latent_functions import choose_functions


def test_create_run_with_one_function_per_team(tmp_path):
    task = lare_rl.load_task("CompetitivePP-6")
    settings = resolve(lare_rl.Settings(method="lare-rd"), task)
    functions = [lare_rl.design(role, draw=1) for role in task.roles]
    assert choose_functions(task, settings, functions) == tuple(functions)
    run = create_run(tmp_path / "run", task, settings, functions)
    assert [function.digest for function in open_run(run.directory).functions] == [phi.digest for phi in functions]
    with pytest.raises(LareError, match="CompetitivePP-6-predator, CompetitivePP-6-prey; 1 "):
        choose_functions(task, settings, functions[0])
    predator, prey = (run.directory / f"latent_function_{team}.py" for team in ("predator", "prey"))
    predator.write_bytes(prey.read_bytes())
    with pytest.raises(LareError, match=r"latent_function_predator.py is not the function"):
        open_run(run.directory)


@pytest.mark.parametrize("max_operations", [decoder_inputs.MAX_COMPILED_OPERATIONS, 0])
def test_compute_factors_of_state(max_operations, echo, monkeypatch):
    """One row in each step: the global state, and all actions concatenated. Large graphs are computed by NumPy."""
    monkeypatch.setattr(decoder_inputs, "MAX_COMPILED_OPERATIONS", max_operations)
    task = echo.model_copy(update={"credit_scope": "state", "observation_size": 9, "action_size": 9})
    source = "def evaluation_func(s, a):\n    return [np.sum(s * a, axis=1, keepdims=True), s[:, 0:1]]\n"
    graph, steps = verify_function(source, task).graph, random_steps(Echo.spec)
    for scored_observation in ("before", "after"):
        config = small_config("lare-rd", "qmix", Echo.spec, credit_scope="state", scored_observation=scored_observation)
        state = (steps.timestep if scored_observation == "before" else steps.next_timestep).state
        expected = np.stack([(state * steps.action.reshape(state.shape)).sum(axis=-1), state[..., 0]], axis=-1)
        z = decoder_inputs.compute_factors([graph], jax.tree.map(jnp.asarray, steps), config)
        np.testing.assert_allclose(z[..., 0, :], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(("algorithm", "method"), [("qmix", "dense"), ("qmix", "lare-rd"), ("ippo", "lare-bayes")])
def test_many_agents_learn_echo(algorithm, method, echo, tmp_path):
    """A random policy is right at less than half of the steps. An episode has 3 to 6 steps, 4.5 on average."""
    small = {"hidden": 16, "embed": 8, "hypernet": 8, "learning_rate": 5e-3, "batch_size": 32, "epsilon_steps": 2000}
    settings = lare_rl.Settings(
        algorithm=algorithm,
        method=method,
        environments=16,
        rollout_steps=10,
        steps=8000,
        evaluate_every=8000,
        evaluation_episodes=50,
        qmix={**small, "update_every": 4, "target_every": 40, "gamma": 0.5},
        ippo={"hidden": (32,), "learning_rate": 5e-3, "gamma": 0.5, "epochs": 5, "minibatch_size": 120},
        credit={"hidden": (32,), "learning_rate": 3e-3, "batch_steps": 100, "sampled_steps": 4, "score": "sum"},
    )
    function = None if method == "dense" else verify_function(ECHO_PHI, echo)
    line = train_quietly(echo, settings, tmp_path / "run", function).metrics()[-1]
    assert line["evaluation/return"] > 0.9 * line["evaluation/length"]
    assert 4 < line["evaluation/length"] < 5
    if function is not None:
        assert line["credit/correlation"] > 0.7
