"""Evaluation, policies and films of runs with a single agent."""

from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lare_rl
from helpers.toy_envs import toy_spec
from lare_rl.envs.families import make_host_env
from lare_rl.envs.gymnasium_env import GymnasiumEnv
from lare_rl.envs.workers import LocalVecEnv
from lare_rl.errors import LareError
from lare_rl.evaluation import evaluate
from lare_rl.evaluation.evaluate import (
    RANDOM_EPISODES,
    evaluate_run,
    gain_over_random,
    measure_random_returns,
    play_random,
)
from lare_rl.evaluation.policy import load_policy
from lare_rl.evaluation.video import check_video_path, write_video
from lare_rl.training.compiled import compile_functions
from lare_rl.training.saved_state import load_learner
from lare_rl.training.unroll_host import HostPolicy, evaluate_on_host
from lare_rl.util.statistics import format_mean_std


@pytest.fixture(scope="module")
def run(small, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "run"
    return lare_rl.train(toy_spec(), small(method="dense", steps=60), out=out, listeners=[])


def test_write_video(tmp_path):
    frames = [np.full((16, 16, 3), 20 * i, np.uint8) for i in range(5)]
    write_video(tmp_path / "film.gif", frames, 0.05)
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF8")
    with pytest.raises(LareError, match="cannot be written"):
        write_video(tmp_path / "none" / "film.gif", frames, 0.05)


@pytest.mark.parametrize(("name", "words"), [("film.xyz", r"\.gif, or in \.mp4"), ("none/film.gif", "no directory")])
def test_check_video_path(tmp_path, name, words):
    with pytest.raises(LareError, match=words):
        check_video_path(tmp_path / name)


def test_gain_over_random():
    """The error is the larger one of that over the seeds and that over the episodes, with that of random actions."""
    random = np.array([0.0, 2.0])  # variance 2
    seeds_differ = np.array([[10.0, 10.0], [14.0, 14.0]])  # variance 8 over the seeds
    assert gain_over_random(seeds_differ, random) == pytest.approx((11.0, np.sqrt(2 / 2 + 8 / 2)))
    episodes_differ = np.array([[10.0, 14.0], [10.0, 14.0]])
    assert gain_over_random(episodes_differ, random) == pytest.approx((11.0, np.sqrt(2 / 2 + 8 / 4)))
    assert gain_over_random(np.array([[10.0]]), random) is None


def test_random_play_is_bounded(monkeypatch):
    assert len(measure_random_returns(toy_spec())) == RANDOM_EPISODES
    assert len(measure_random_returns(toy_spec(environment="no-such-environment"))) == 0
    monkeypatch.setattr(evaluate, "RANDOM_PLAY_LIMIT_S", -1.0)
    assert len(measure_random_returns(toy_spec())) == 0


def test_measures_of_random_play(small, tmp_path, command):
    task = toy_spec(measures=("distance",))
    lare_rl.train(task, small(method="dense", steps=60, seeds=1), out=tmp_path / "run", listeners=[])
    status, out, err = command("evaluate", tmp_path / "run", "--episodes", 3)
    assert (status, err) == (0, "")
    distances = np.array([episode.measures["distance"] for episode in play_random(task)])
    assert f"random actions: distance {format_mean_std(distances)}" in out.splitlines()
    assert distances.std() > 0


def test_evaluate_in_several_batches(run, monkeypatch):
    """Every episode begins from a different initial state, and no environment stays open."""
    returns = evaluate_run(run, 5)["Chase"]
    assert returns.shape == (2, 5)
    assert len(np.unique(returns)) == 10
    opened, closed = [], []
    monkeypatch.setattr(evaluate, "MAX_OPEN_ENVS", 2)
    monkeypatch.setattr(evaluate, "make_host_env", lambda task: opened.append(make_host_env(task)) or opened[-1])
    monkeypatch.setattr(GymnasiumEnv, "close", lambda env: closed.append(env))
    np.testing.assert_allclose(evaluate_run(run, 5)["Chase"], returns, rtol=1e-5)
    assert len(opened) == 2 * 5
    assert set(map(id, opened)) <= set(map(id, closed))


def test_evaluate_no_episodes(run):
    with pytest.raises(LareError, match="episodes = 0"):
        evaluate_run(run, 0)


def test_evaluate_continues_after_initial_states_of_run(run):
    state = load_learner(run)
    functions = compile_functions(state.config)
    policy = HostPolicy(functions, state.config, functions.get_actor(state.learner, 60), run.seeds, 4)
    with LocalVecEnv([partial(make_host_env, toy_spec())] * 8) as envs:
        returns = evaluate_on_host(envs, policy, run.seeds, 4).returns[..., 0]
    last_evaluation = [line["evaluation/return"] for line in run.metrics()[-2:]]
    np.testing.assert_allclose(returns[:, :2].mean(axis=1), last_evaluation, rtol=1e-5)
    np.testing.assert_allclose(evaluate_run(run, 2)["Chase"], returns[:, 2:], rtol=1e-5)


def test_load_policy(run):
    observation = np.ones(toy_spec().observation_size, np.float32)
    actors = load_learner(run).learner.algorithm.online.actor
    env_actions = 2 * jnp.tanh(jax.vmap(lambda actor: actor(jnp.ones((1, 2))))(actors))
    for seed_index, seed in enumerate(run.seeds):
        np.testing.assert_allclose(load_policy(run, seed)(observation), env_actions[seed_index, 0], rtol=1e-5)
    np.testing.assert_array_equal(load_policy(run)(observation), load_policy(run, 0)(observation))
    with pytest.raises(LareError, match="no seed 7"):
        load_policy(run, 7)


@pytest.mark.parametrize(
    ("observation", "words"),
    [("x", "no array"), (np.ones(3), "the shape is"), (np.full(2, np.nan), "not finite"), (np.ones((0, 2)), "shape")],
)
def test_policy_checks_observations(run, observation, words):
    with pytest.raises(LareError, match=words):
        load_policy(run)(observation)


def test_policy_with_discrete_actions(small, tmp_path):
    spec = toy_spec(environment="toys/Pick-v0", observation_size=4, action_size=4)
    run = lare_rl.train(spec, small(method="dense", algorithm="ppo"), out=tmp_path / "run", listeners=[])
    policy, observation = load_policy(run), np.eye(4, dtype=np.float32)[2]
    assert gymnasium.make("toys/Pick-v0").action_space.contains(np.int64(policy(observation)))
    np.testing.assert_array_equal(np.sort(policy.select_env_action(observation)), [0, 0, 0, 1])
    # A policy that has hardly been trained makes every choice, in training's evaluations and here.
    batch = np.tile(observation, (400, 1))
    choices = load_policy(run)(batch)
    assert np.bincount(choices).min() > 60
    np.testing.assert_array_equal(load_policy(run)(batch), choices)
    # Without noise it makes the likeliest choice alone, and so do evaluations.
    assert set(load_policy(run, deterministic=True)(batch)) == {np.argmax(np.bincount(choices))}
    sampled, likeliest = (evaluate_run(run, 4, deterministic=flag)["Chase"] for flag in (False, True))
    assert not np.array_equal(sampled, likeliest)


def test_many_agents_have_no_single_policy(small_many, tmp_path):
    run = lare_rl.train("TriangleArea", small_many(method="dense", seeds=1, steps=100), out=tmp_path / "run")
    with pytest.raises(LareError, match="many agents"):
        load_policy(run)
