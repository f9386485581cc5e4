"""Findings about large observations, and about policies that do not change."""

import json

import numpy as np
import pytest

import lare_rl
from helpers.toy_envs import pick_spec, toy_spec
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.runs.config_file import make_config
from lare_rl.runs.directory import Run
from lare_rl.runs.metric_names import RETURN, RETURN_STD
from lare_rl.training.advice import (
    MESSAGES,
    find_constant_returns,
    find_equal_returns,
    find_large_observations,
    find_saturated_policies,
    find_untrained,
)
from lare_rl.training.evaluation import N_STATES, greedy_actions, saturation
from lare_rl.training.policy import get_actor
from lare_rl.training.saved_state import load_learner
from lare_rl.util.findings import render


@pytest.mark.parametrize(
    ("settings", "factor", "text"),
    [
        ({}, 1, None),
        ({}, 50, "--algorithm ppo"),
        ({}, 1e30, "--algorithm ppo"),  # its square overflows in float32
        ({"algorithm": "ppo"}, 50, None),  # it normalises observations
        ({"algorithm": "ppo", "ppo": {"normalise_observations": False}}, 50, "--ppo.normalise-observations"),
    ],
)
def test_large_observations(settings, factor, text, dense_run):
    config, learner, _, _ = load_learner(dense_run)
    observation = learner.replay.columns["observation"] * np.float32([1, factor])
    resolved = resolve(Settings(method="rrdu", **settings), toy_spec())
    task = dense_run.config.task.model_copy(update={"observation": "0: the target\n1: light (W/m²)"})
    run_config = dense_run.config.model_copy(update={"settings": resolved, "task": task})
    replay = learner.replay._replace(columns={"observation": observation})
    findings = find_large_observations(Run(dense_run.directory, run_config, ()), replay, config)
    messages = [render(finding, MESSAGES) for finding in findings]
    assert len(messages) == (text is not None)
    assert all("light (W/m²)" in message and text in message for message in messages)


def test_constant_returns():
    for returns, is_found in [
        ([[7.5, 8.0]] * 5, True),
        ([[7.5, 8.0]] * 6, False),  # it was reported before
        ([[7.5, 8.0]] * 6 + [[9.0, 8.0]] + [[7.5, 8.0]] * 5, True),
        ([[7.5, float(step)] for step in range(5)], False),
        ([[np.nan]] * 5, False),
    ]:
        findings = find_constant_returns([np.array(per_seed) for per_seed in returns])
        assert [finding.code for finding in findings] == ["constant returns"] * is_found


def test_equal_returns(tmp_path):
    """Equal returns are reported if there are enough evaluated episodes, and if all evaluations have them."""
    settings = resolve(Settings(method="dense", steps=100, evaluation_episodes=4), toy_spec())
    run, zero = Run(tmp_path, make_config(toy_spec(), settings, ()), ()), (0.0, 0.0)
    for values, is_found in (
        ([(7.1, 1e-9)] * 3, True),
        ([zero, zero, (0.0, 0.1)], False),
        ([zero, zero, (None, None)], False),
        ([zero, zero], False),
    ):
        lines = [{"step": k, "seed": 0, RETURN: return_, RETURN_STD: std} for k, (return_, std) in enumerate(values)]
        (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        assert [finding.code for finding in find_equal_returns(run)] == ["equal returns"] * is_found


STUCK = np.full((1, 4, 2), [[1.0, -0.995]])


@pytest.mark.parametrize(
    ("action", "saturations", "start"),
    [
        (STUCK, [1.0], "The policy chooses"),
        (np.concatenate([STUCK * 0.5, STUCK]), [0.0, 1.0], "The policy of seed 4 chooses"),
        (np.concatenate([STUCK, -STUCK, STUCK * 0.5]), [1.0, 1.0, 0.0], "The policy of seeds 3, 4 chooses"),
        (STUCK * [1.0, 0.9], [0.5], None),  # one component is not at a bound
        (STUCK * [[1.0], [1.0], [-1.0], [1.0]], [0.0], None),  # from one bound to the other
    ],
)
def test_saturated_policies(action, saturations, start):
    assert list(saturation(action)) == saturations
    messages = [
        render(finding, MESSAGES) for finding in find_saturated_policies(saturations, range(3, 3 + len(action)))
    ]
    assert [message[: len(start or "")] for message in messages] == ([] if start is None else [start])


def test_greedy_actions_of_newest_states(dense_run):
    config, learner, host, _ = load_learner(dense_run)
    replay, actor = learner.replay, get_actor(learner.algorithm, host["step"], config)
    actions = greedy_actions(actor, replay, config)
    assert actions.shape == (2, N_STATES, 1)
    rows = (int(replay.next_row[1, 0]) - np.arange(1, 6)) % 64
    observation = np.asarray(replay.columns["observation"][1, 0, rows, 0])
    policy = lare_rl.load_policy(dense_run, seed=dense_run.seeds[1])
    np.testing.assert_allclose(2 * actions[1, :5], policy(observation), rtol=1e-5)


@pytest.mark.parametrize(
    ("settings", "step", "loss", "expected"),
    [
        ({"td3": {"warmup": 60}}, 50, {}, ("steps so far random", {"step": 50, "warmup": 60})),
        ({"td3": {"warmup": 50}}, 60, {}, ("steps so far random", {"step": 60, "warmup": 60})),  # whole iterations
        ({"td3": {"warmup": 60}}, 90, {"critic/loss": 0.0}, None),
        ({"algorithm": "qmix"}, 90, {}, ("too few episodes", {"step": 90, "algorithm": "qmix", "batch_size": 128})),
        ({"algorithm": "qmix"}, 90, {"actor/objective": 2.0, "critic/loss_prey": None}, None),  # as a plugin names it
    ],
)
def test_untrained_policy(settings, step, loss, expected, tmp_path):
    spec = pick_spec() if "algorithm" in settings else toy_spec()
    config = make_config(spec, resolve(Settings(method="dense", steps=100, rollout_steps=20, **settings), spec), ())
    run = Run(tmp_path, config, ())
    assert find_untrained(run) is None  # there is no evaluation yet
    line = {"step": step, "seed": 0, "evaluation/return": 1.0, **loss}
    (tmp_path / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    finding = find_untrained(run)
    assert (finding is None) == (expected is None)
    if finding is not None:
        assert finding.code == expected[0]
        assert finding.values.items() >= expected[1].items()
        assert f"{step:,} steps" in render(finding, MESSAGES)
