"""Findings about large observations, and about policies that do not change."""

import json

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

import lare_rl
from helpers.listeners import MessageListener
from helpers.toy_envs import Chase, pick_spec, toy_spec
from helpers.training_runs import CHASE, train_quietly
from lare_rl.algorithms.ppo import PPOSettings
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.runs.config_file import make_config
from lare_rl.runs.directory import Run
from lare_rl.training.advice import (
    MESSAGES,
    find_constant_returns,
    find_large_observations,
    find_saturated_policies,
    find_untrained,
    saturation,
)
from lare_rl.training.saved_state import load_learner
from lare_rl.training.session import restore_session
from lare_rl.util.findings import render


class Bright(Chase):
    """The second feature of the observation is a light of up to 900 W/m²."""

    observation_space = Box(-1000, 1000, (2,), np.float32)

    def observe(self):
        return super().observe() * np.array([1, 900], np.float32)


gymnasium.register("toys/Bright-v0", entry_point=Bright, max_episode_steps=20)

BRIGHT = CHASE.model_copy(
    update={"name": "Bright", "environment": "toys/Bright-v0", "observation": "0: the target\n1: light (W/m²)"}
)


def test_large_observations_are_reported_once(dense, tmp_path):
    """Of a run with small observations, `test_train.py` sees that there is no such message."""
    listener = MessageListener()
    train_quietly(BRIGHT, dense(steps=60), tmp_path / "run", listeners=[listener])
    (message,) = (line for line in listener.messages if line.startswith("Observations are large"))
    assert "light (W/m²)" in message
    assert "--algorithm ppo" in message


@pytest.mark.parametrize(("normalise", "expected"), [(True, []), (False, ["large observations"])])
def test_large_observations_of_ppo(normalise, expected, dense_run):
    config, learner, _, _ = load_learner(dense_run)
    replay = learner.replay._replace(columns={"observation": 50 * learner.replay.columns["observation"]})
    settings = Settings(method="rrdu", algorithm="ppo", ppo=PPOSettings(normalise_observations=normalise))
    run_config = dense_run.config.model_copy(update={"settings": resolve(settings, toy_spec())})
    findings = find_large_observations(Run(dense_run.directory, run_config, ()), replay, config)
    assert [finding.code for finding in findings] == expected


@pytest.mark.parametrize(
    ("returns", "is_found"),
    [
        ([[7.5, 8.0]] * 4, False),
        ([[7.5, 8.0]] * 5, True),
        ([[7.5, 8.0]] * 6, False),  # it was reported before
        ([[7.5, 8.0]] * 6 + [[9.0, 8.0]] + [[7.5, 8.0]] * 5, True),
        ([[7.5, float(step)] for step in range(5)], False),
        ([[0.0]] * 5, True),
        ([[-7.5], [-7.5001], [-7.5], [-7.5], [-7.5]], True),
    ],
)
def test_constant_returns(returns, is_found):
    findings = find_constant_returns([np.array(per_seed) for per_seed in returns])
    assert [finding.code for finding in findings] == ["constant returns"] * is_found


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
    findings = find_saturated_policies(saturations, range(3, 3 + len(action)))
    assert len(findings) == (start is not None)
    for finding in findings:
        assert render(finding, MESSAGES).startswith(start)


def test_greedy_actions_of_newest_states(dense_run):
    session, _ = restore_session(dense_run)
    actions = session.greedy_actions(5)
    session.close()
    assert actions.shape == (2, 5, 1)
    replay = session.learner.replay
    rows = (int(replay.next_row[1, 0]) - np.arange(1, 6)) % 64
    observation = np.asarray(replay.columns["observation"][1, 0, rows, 0])
    policy = lare_rl.load_policy(dense_run, seed=dense_run.seeds[1])
    np.testing.assert_allclose(2 * actions[1], policy(observation), rtol=1e-5)


@pytest.mark.parametrize(
    ("settings", "step", "loss", "expected"),
    [
        ({"td3": {"warmup": 60}}, 50, {}, ("steps so far random", {"step": 50, "warmup": 60})),
        ({"td3": {"warmup": 60}}, 50, {"critic/loss": None}, ("steps so far random", {})),
        ({"td3": {"warmup": 60}}, 90, {"critic/loss": 0.0}, None),
        ({"algorithm": "qmix"}, 90, {}, ("too few episodes", {"step": 90, "algorithm": "qmix", "batch_size": 128})),
        ({"algorithm": "qmix"}, 90, {"critic/loss/prey": 2.0}, None),
    ],
)
def test_untrained_policy(settings, step, loss, expected, tmp_path):
    spec = pick_spec() if "algorithm" in settings else toy_spec()
    config = make_config(spec, resolve(Settings(method="dense", steps=100, **settings), spec), ())
    run = Run(tmp_path, config, ())
    assert find_untrained(run) is None  # there is no evaluation yet
    line = {"step": step, "seed": 0, "evaluation/return": 1.0, **loss}
    (tmp_path / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    finding = find_untrained(run)
    if expected is None:
        assert finding is None
    else:
        assert finding.code == expected[0]
        assert finding.values.items() >= expected[1].items()
        assert f"{step:,} steps" in render(finding, MESSAGES)
