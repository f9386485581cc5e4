"""Evaluation, policies and films of runs with a single agent."""

import re
from functools import partial

import gymnasium
import numpy as np
import pytest
from PIL import Image

import lare_rl
from helpers.toy_envs import Chase, levels_spec, pick_spec, toy_spec
from helpers.untrained_runs import untrained_run
from lare_rl.envs.placement import make_host_env
from lare_rl.envs.vec_env import LocalVecEnv
from lare_rl.errors import LareError, check_count, install_command
from lare_rl.evaluation import evaluate as module
from lare_rl.evaluation import video
from lare_rl.evaluation.evaluate import (
    MAX_OPEN_ENVS,
    MIN_RANDOM_EPISODES,
    RANDOM_EPISODES,
    evaluate_policy,
    evaluate_run,
    evaluation_seeds,
    gain_over_random,
    measure_random_returns,
    play_random,
)
from lare_rl.evaluation.video import check_video_path, record_video, write_video
from lare_rl.report.evaluation_lines import describe_evaluation
from lare_rl.runs.metric_names import DETERMINISTIC_RETURN
from lare_rl.training.policy import get_actor
from lare_rl.training.saved_state import load_learner
from lare_rl.training.unroll_host import evaluate_batch_on_host, evaluation_policy
from lare_rl.util.statistics import format_mean_std


class FilmedChase(Chase):
    """It can be rendered, at 50 frames a second. It counts environments that are open."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012
    open_envs: set[int] = set()  # noqa: RUF012
    max_open = 0

    def __init__(self, render_mode=None):
        super().__init__()
        self.render_mode, self.n_frames = render_mode, 0
        self.open_envs.add(id(self))
        FilmedChase.max_open = max(FilmedChase.max_open, len(self.open_envs))

    def render(self):
        self.n_frames += 1  # a GIF has no equal frames
        return np.full((16, 16, 3), 20 * self.n_frames % 256, np.uint8)

    def close(self):
        self.open_envs.discard(id(self))


gymnasium.register("toys/FilmedChase-v0", entry_point=FilmedChase, max_episode_steps=20)
TASK = toy_spec(environment="toys/FilmedChase-v0", measures=("distance",))


@pytest.fixture(scope="module")
def run(small, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "run"
    return lare_rl.train(TASK, small(method="dense", steps=60, capacity=64), out=out, listeners=[])


@pytest.fixture(scope="module")
def returns(run):
    """Returns of one episode more than there may be open environments of a seed."""
    FilmedChase.max_open = 0
    return evaluate_run(run, MAX_OPEN_ENVS + 1)["Chase"]


def test_write_video(tmp_path, monkeypatch):
    frames = [np.full((16, 16, 3), 20 * i, np.uint8) for i in range(5)]
    write_video(tmp_path / "film.gif", frames, 0.05)
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF8")
    with pytest.raises(LareError, match="cannot be written") as error:
        write_video(tmp_path / "none" / "film.gif", frames, 0.05)
    assert "needs lare-rl" not in str(error.value)
    for name, words in (("film.xyz", r"\.gif, or in \.mp4"), ("none/film.gif", "no directory")):
        with pytest.raises(LareError, match=words):
            check_video_path(tmp_path / name)
    monkeypatch.setattr(video, "find_spec", lambda package: None)
    for name, extra in (("film.gif", "report"), ("film.mp4", "video")):
        with pytest.raises(LareError, match=re.escape(install_command(extra))):
            check_video_path(tmp_path / name)


def test_record_video(run, tmp_path, monkeypatch):
    """A GIF has at most 25 frames a second, so it shows every second step. Gymnasium accepts a rate of None."""
    record_video(run, tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as film:
        assert (film.n_frames, film.info["duration"]) == (10, 40)
    monkeypatch.setitem(FilmedChase.metadata, "render_fps", None)
    assert video.record_frames(run, max_frames=2)[1] == 2 / video.DEFAULT_FPS
    assert not FilmedChase.open_envs


def test_record_video_refuses(run, tmp_path, monkeypatch):
    """Of many agents on the host, none plays first."""
    monkeypatch.setattr(FilmedChase, "render", lambda env: None)
    monkeypatch.setattr(video, "play_run", lambda run: pytest.fail("an episode was played"))
    toy = toy_spec(environment="pettingzoo/helpers.parallel_toy_envs:Toy", observation_size=2, action_size=3)
    for task, words in (
        (TASK, "no picture"),
        (toy_spec(), r"toys/Chase-v0.* cannot be made"),
        (toy, "leave the video out"),
    ):
        with pytest.raises(LareError, match=words):
            record_video(replace_task(run, task), tmp_path / "film.gif")


def replace_task(run, task):
    return type(run)(run.directory, run.config.model_copy(update={"task": task}), run.functions)


def test_gain_over_random():
    """The error over the seeds or over the episodes, whichever is larger, is combined with the error of random actions."""
    random = np.array([0.0, 2.0])  # variance 2
    seeds_differ = np.array([[10.0, 10.0], [14.0, 14.0]])  # variance 8 over the seeds
    assert gain_over_random(seeds_differ, random) == pytest.approx((11.0, np.sqrt(2 / 2 + 8 / 2)))
    episodes_differ = np.array([[10.0, 14.0], [10.0, 14.0]])
    assert gain_over_random(episodes_differ, random) == pytest.approx((11.0, np.sqrt(2 / 2 + 8 / 4)))
    assert gain_over_random(np.array([[10.0]]), random) is None


def test_random_play_is_bounded(monkeypatch):
    """It has a few episodes more than the limit of time allows, unless they take minutes."""
    (episodes,) = play_random(TASK, limit_s=60.0)
    assert len(episodes) == RANDOM_EPISODES
    assert not FilmedChase.open_envs
    assert measure_random_returns(toy_spec(environment="no-such-environment")).shape == (1, 0)
    assert measure_random_returns(TASK, 12).shape == (1, 12)
    assert len(play_random(TASK, limit_s=-1.0)[0]) == MIN_RANDOM_EPISODES
    numbers = []
    play_random(TASK, 3, on_episode=numbers.append)
    assert numbers == [1, 2, 3]
    monkeypatch.setattr(module, "FEW_EPISODES_PLAY_S", -1.0)
    assert play_random(TASK, limit_s=-1.0) == [[]]


@pytest.mark.long
def test_most_likely_actions_beside_sampled_ones(small, tmp_path, command):
    """Of a policy over choices: at the last evaluation, and by `lare-rl evaluate`, with the difference from random actions."""
    settings = small(algorithm="ppo", method="dense", steps=120)
    run = lare_rl.train(pick_spec(), settings, out=tmp_path / "run", listeners=[])
    assert [DETERMINISTIC_RETURN in line for line in run.metrics()] == [False, False, True, True]
    status, out, err = command("evaluate", run.directory, "--episodes", 4)
    lines = out.splitlines()
    assert (status, err) == (0, "")
    likeliest = evaluate_run(run, 4, deterministic=True)["Pick"]
    (index,) = (i for i, line in enumerate(lines) if "The most likely ones" in line)
    for row, line in zip(likeliest, lines[index + 1 :], strict=False):
        assert format_mean_std(row) in line
    assert any(line.startswith("random actions: return") and "over 10 episodes" in line for line in lines)
    assert any(line.startswith("difference: ") for line in lines)


def test_measures_of_random_play(run, command):
    status, out, err = command("evaluate", run.directory, "--episodes", 4)
    assert (status, err) == (0, "")
    distances = np.array(
        [episode.measures["distance"] for episode in play_random(TASK, seeds=evaluation_seeds(run, 4))[0]]
    )
    assert f"random actions: distance {format_mean_std(distances)}" in out.splitlines()
    assert distances.std() > 0


@pytest.mark.long
def test_random_actions_play_the_same_groups(small, tmp_path, command):
    """Otherwise a sentence says so. The mean of the numbers of the groups is not reported."""
    task = levels_spec(payments=2)
    run = untrained_run(task, small(method="dense", capacity=64), tmp_path / "run")
    status, out, err = command("evaluate", run.directory, "--episodes", 3)
    assert (status, err) == (0, "")
    assert "over 12 episodes" in out
    assert "level" not in out
    by_turns = replace_task(run, levels_spec(environment="toys/LevelsByTurns-v0", payments=2))
    lines = list(
        describe_evaluation(by_turns, evaluate_policy(by_turns, 3), play_random(by_turns.config.task, 3), None)
    )
    assert lines[-1].startswith("random actions did not play the same groups (level)")


def test_evaluate_in_another_environment(run, command):
    status, out, err = command("evaluate", run.directory, "--episodes", 2, "--environment", "toys/Chase-v0")
    assert (status, err) == (0, "")
    assert out.splitlines()[0] == "in toys/Chase-v0 (training was in toys/FilmedChase-v0):"
    assert evaluate_run(run, 2, environment="toys/Chase-v0")["Chase"].shape == (2, 2)
    for name in ("toys/Missing-v0", "other:Chase-v0"):
        with pytest.raises(LareError, match=name):
            evaluate_run(run, environment=name)


def test_evaluate_in_several_batches(run, returns):
    """Every episode begins from a different initial state, and no environment stays open."""
    assert returns.shape == (2, 21)
    assert len(np.unique(returns)) == 42
    assert FilmedChase.max_open == 2 * MAX_OPEN_ENVS
    assert not FilmedChase.open_envs
    assert check_count("episodes", np.int64(2)) == 2
    with pytest.raises(LareError, match="episodes = 0"):
        evaluate_run(run, 0)


def test_evaluate_continues_after_initial_states_of_run(run, returns):
    state = load_learner(run)
    actor = get_actor(state.learner.algorithm, 60, state.config)
    policy = evaluation_policy(state.config, actor, run.seeds, np.arange(4), 4)
    with LocalVecEnv([partial(make_host_env, TASK)] * 8) as envs:
        first_returns = evaluate_batch_on_host(envs, policy, run.seeds, 4).returns[..., 0]
    last_evaluation = [line["evaluation/return"] for line in run.metrics()[-2:]]
    np.testing.assert_allclose(first_returns[:, :2].mean(axis=1), last_evaluation, rtol=1e-5)
    np.testing.assert_allclose(returns[:, :2], first_returns[:, 2:], rtol=1e-5)


def test_policies_and_random_actions_are_evaluated_in_the_evaluation_environment(small, tmp_path):
    gymnasium.register("toys/FarChase-v0", entry_point=lambda: Chase(scale=1000.0), max_episode_steps=20)
    task = TASK.model_copy(update={"evaluation_environment": "toys/FarChase-v0"})
    run = lare_rl.train(task, small(method="dense", steps=60, capacity=64), out=tmp_path / "run", listeners=[])
    evaluations = [line["evaluation/return"] for line in run.metrics()]
    assert max(evaluations) < -500  # a thousand times the training rewards
    assert evaluate_run(run, 2)["Chase"].max() < -500
    assert measure_random_returns(task).max() < -500
