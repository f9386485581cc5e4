from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lare_rl
from helpers.toys import toy_spec
from lare_rl.compare.statistics import mean_and_deviation, plus_minus
from lare_rl.envs.families import make_host_env
from lare_rl.envs.gymnasium_env import GymnasiumEnv
from lare_rl.envs.load import read_task
from lare_rl.envs.workers import LocalEnvs
from lare_rl.errors import LareError
from lare_rl.evaluation import evaluate as evaluation
from lare_rl.evaluation.evaluate import above_chance, evaluate_run, random_play
from lare_rl.evaluation.policy import policy_of
from lare_rl.evaluation.video import check_video, write_video
from lare_rl.training.collect_host import evaluate, policy
from lare_rl.training.compiled import compiled
from lare_rl.training.session import load_learner


def test_a_gif_is_written(tmp_path):
    frames = [np.full((16, 16, 3), 20 * number, np.uint8) for number in range(5)]
    write_video(tmp_path / "film.gif", frames, 0.05)
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF8")


def test_a_video_nowhere_is_one_line(tmp_path):
    with pytest.raises(LareError, match="cannot be written"):
        write_video(tmp_path / "none" / "film.gif", [np.zeros((16, 16, 3), np.uint8)] * 2, 0.05)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("film.xyz", r"film\.xyz is no name of a video: it ends in \.gif, or in \.mp4"),
        ("none/film.gif", r"film\.gif cannot be written: there is no directory .*none$"),
    ],
)
def test_a_video_that_could_not_be_written_is_not_begun(tmp_path, name, message):
    with pytest.raises(LareError, match=message):
        check_video(tmp_path / name)


def test_the_error_of_a_difference_is_the_larger_of_two():
    """Over the seeds, or over the episodes, and that of random actions."""
    random = np.array([0.0, 2.0])  # variance 2
    apart = np.array([[10.0, 10.0], [14.0, 14.0]])  # seeds with variance 8, which do not vary from episode to episode
    assert above_chance(apart, random) == pytest.approx((11.0, np.sqrt(2 / 2 + 8 / 2)))
    alike = np.array([[10.0, 14.0], [10.0, 14.0]])
    assert above_chance(alike, random) == pytest.approx((11.0, np.sqrt(2 / 2 + 8 / 4)))
    assert above_chance(np.array([[10.0]]), random) is None


def test_measures_of_random_play_stand_beside_those_of_the_policy(small, tmp_path, command):
    task = toy_spec(measures=("distance",))
    lare_rl.train(task, small(method="dense", steps=60, seeds=1), out=tmp_path / "run", listeners=[])
    status, out, err = command("evaluate", tmp_path / "run", "--episodes", 3)
    assert (status, err) == (0, "")
    random = np.array([one.measures["distance"] for one in random_play(task)])
    shown = plus_minus(*mean_and_deviation(random))
    assert [line.split()[:3] for line in out.splitlines()[3:4]] == [["seed", "0:", "distance"]]
    assert out.splitlines()[4] == f"random actions: distance {shown}"
    assert random.std() > 0


def test_more_episodes_than_there_are_environments_begin_each_from_a_start_of_its_own(small, tmp_path, monkeypatch):
    run = lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[])
    whole = evaluate_run(run, 5)["Chase"]
    assert whole.shape == (2, 5)
    assert len(np.unique(whole)) == 10
    opened, closed = [], []
    monkeypatch.setattr(evaluation, "AT_A_TIME", 2)
    monkeypatch.setattr(evaluation, "make_host_env", lambda task: opened.append(make_host_env(task)) or opened[-1])
    monkeypatch.setattr(GymnasiumEnv, "close", lambda environment: closed.append(environment))
    np.testing.assert_allclose(evaluate_run(run, 5)["Chase"], whole, rtol=1e-5)
    assert len(opened) == 2 * 5
    assert set(map(id, opened)) <= set(map(id, closed))


def test_no_episodes(small, tmp_path):
    run = lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[])
    with pytest.raises(LareError, match="episodes = 0: a whole number, 1 or more"):
        evaluate_run(run, 0)


def test_its_starts_are_those_of_no_evaluation_of_the_run(small, tmp_path):
    run = lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[])
    config, learner, _, _ = load_learner(run)
    functions = compiled(config)
    act = policy(functions, config, functions.actor(learner, 60), run.seeds, 4)
    with LocalEnvs([partial(make_host_env, toy_spec())] * 8) as envs:
        returns = evaluate(envs, act, run.seeds, 4).returns[..., 0]
    np.testing.assert_allclose(
        returns[:, :2].mean(axis=1), [line["evaluation/return"] for line in run.metrics()[-2:]], rtol=1e-5
    )
    np.testing.assert_allclose(evaluate_run(run, 2)["Chase"], returns[:, 2:], rtol=1e-5)


def test_the_policy_of_each_seed(small, tmp_path):
    run = lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[])
    observation = np.ones(toy_spec().observation_size, np.float32)
    learner = load_learner(run)[1]
    together = 2 * jnp.tanh(
        jax.vmap(lambda actor: actor(jnp.ones((1, 2))))(learner.algorithm.online.actor)
    )  # in its units
    for place, seed in enumerate(run.seeds):
        np.testing.assert_allclose(policy_of(run, seed)(observation), together[place, 0], rtol=1e-5)
    np.testing.assert_array_equal(policy_of(run)(observation), policy_of(run, 0)(observation))
    with pytest.raises(LareError, match=r"run has no seed 7; its seeds: 0, 1$"):
        policy_of(run, 7)


def test_the_policy_of_a_choice_gives_what_the_environment_takes(small, tmp_path):
    spec = toy_spec(environment="toys/Pick-v0", observation_size=4, action_size=4)
    run = lare_rl.train(spec, small(method="dense", algorithm="ppo"), out=tmp_path / "run", listeners=[])
    policy, observation = policy_of(run), np.eye(4, dtype=np.float32)[2]
    assert gymnasium.make("toys/Pick-v0").action_space.contains(np.int64(policy(observation)))
    np.testing.assert_array_equal(np.sort(policy.row(observation)), [0, 0, 0, 1])
    # A policy that has hardly been trained makes every choice, in training's evaluations and here.
    many = np.tile(observation, (400, 1))
    chosen = policy_of(run)(many)
    assert np.bincount(chosen).min() > 60
    np.testing.assert_array_equal(policy_of(run)(many), chosen)
    # Without noise it makes the likeliest of them alone, and so do evaluations.
    assert set(policy_of(run, deterministic=True)(many)) == {np.argmax(np.bincount(chosen))}
    sampled, likeliest = (lare_rl.evaluate_run(run, 4, deterministic=which)["Chase"] for which in (False, True))
    assert not np.array_equal(sampled, likeliest)


def test_many_agents_have_no_single_policy(small_many, tmp_path):
    run = lare_rl.train(read_task("TriangleArea"), small_many(method="dense", seeds=1, steps=100), out=tmp_path / "run")
    with pytest.raises(LareError, match="run is a run of TriangleArea: many agents have no single policy"):
        policy_of(run)
