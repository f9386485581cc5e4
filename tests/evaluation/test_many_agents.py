"""Rollouts, samples, cross-play, films and reports of runs with many agents."""

import re
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

import lare_rl
from helpers.markup import check_markup
from lare_rl.envs.families import make_env
from lare_rl.envs.interface import team_mean
from lare_rl.errors import LareError
from lare_rl.evaluation.cross_play import cross_play
from lare_rl.evaluation.played_episodes import play_run
from lare_rl.evaluation.video import record_frames
from lare_rl.report.overview import render_learning_curves
from lare_rl.report.reported_run import ReportedRun
from lare_rl.report.run_details import render_details
from lare_rl.training.collect_device import unroll_on_device
from lare_rl.training.policy import get_actor
from lare_rl.training.saved_state import load_learner

pytestmark = pytest.mark.long

N_EPISODES = 8


@pytest.fixture(scope="module")
def runs(tmp_path_factory, small_many):
    """Two runs with two teams. They run the same compiled programs."""
    directory = tmp_path_factory.mktemp("runs")
    return [
        lare_rl.train("CompetitivePP-6", small_many(seed=seed), out=directory / str(seed), listeners=[])
        for seed in (0, 2)
    ]


def test_rollout(runs):
    played = play_run(runs[0])
    assert played.state.world.position.shape == (25, 1, 11, 2)
    assert played.reward.shape == played.proxy_reward.shape == played.credit.shape == (25, 1, 8)
    assert played.proxy_reward.std() > 0
    assert played.select_episode(played.reward).shape == (25, 8)
    assert [frame.shape for frame in record_frames(runs[0])[0]] == [(400, 400, 3)] * 25


def test_cross_play(runs, command):
    matches = cross_play((runs[0], runs[1]), episodes=N_EPISODES)
    assert [(match.first, match.second) for match in matches] == [(a, b) for a in runs for b in runs]
    assert all(match.returns.shape == (2, 2) and np.isfinite(match.returns).all() for match in matches)
    assert len({match.returns[0, 1] for match in matches}) == 4
    # A policy that plays against itself plays as it does alone.
    state, env = load_learner(runs[0]), make_env(runs[0].config.task)
    play = jax.jit(partial(unroll_on_device, env, n_episodes=N_EPISODES, config=state.config, deterministic=False))
    for seed in range(2):
        learner = jax.tree.map(lambda leaf, seed=seed: leaf[seed : seed + 1], state.learner)
        batch = play(get_actor(learner.algorithm, 200, state.config), jax.random.key(0)[None])
        team, steps = state.config.env.teams[0], batch.steps
        reward = team_mean(steps.next_timestep.reward, steps.timestep.alive, team)
        np.testing.assert_allclose(matches[0].returns[seed, seed], reward.sum(axis=0).mean(), rtol=1e-4)
    status, out, err = command("cross-play", *(run.directory for run in runs), "--episodes", N_EPISODES)
    assert (status, err) == (0, "")
    assert out.count(" ± ") == 5  # four matches, and the line that explains the numbers
    assert out.startswith("predator (rows) against prey")


def change_run(run, **changes):
    updates = {key: getattr(run.config, key).model_copy(update=values) for key, values in changes.items()}
    return replace(run, config=run.config.model_copy(update=updates))


def test_bad_cross_play(runs, make_run):
    chase = make_run("a", [1.0])
    with pytest.raises(LareError, match="episodes = 0"):
        cross_play((runs[0], runs[1]), episodes=0)
    other_algorithm = change_run(runs[0], settings={"algorithm": "other"})
    other_task = change_run(runs[0], task={"description": "Other."})
    for pair, message in [
        ((chase, chase), "two teams that learn, and Chase has 1$"),
        ((chase, runs[0]), "these are of Chase and CompetitivePP-6$"),
        ((runs[0], other_algorithm), "algorithm, and these are of ippo and other$"),
        ((runs[0], other_task), "different tasks with the name CompetitivePP-6:"),
    ]:
        with pytest.raises(LareError, match=message):
            cross_play(pair)


def test_evaluate_command(runs, command, tmp_path):
    status, out, err = command("evaluate", runs[0].directory, "--episodes", 3, "--video", "film.gif")
    assert (status, err) == (0, "")
    names = [f"CompetitivePP-6-{team}, seed {seed}" for team in ("predator", "prey") for seed in runs[0].seeds]
    names += [
        f"CompetitivePP-6-{team}, {line}" for team in ("predator", "prey") for line in ("random actions", "difference")
    ]
    assert set(names) <= {line.split(": ")[0] for line in out.splitlines()}
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF8")


def test_report(runs):
    run = runs[0]
    details = "\n".join(render_details(run, ()))
    check_markup(details.replace('href="#', 'href="'))
    assert "nan" not in details
    for role in run.config.task.roles:
        assert details.count(f"<summary>The latent function phi of {role.name}</summary>") == 1
    assert details.count('class="strip"') == 2  # true and proxy rewards
    assert details.count("correlation with the true reward") == 2
    curves = "\n".join(render_learning_curves(run.config.task, [ReportedRun("a", run)], np.zeros((2, 0))))
    titles = re.findall(r"team of (\w+)</", curves)
    assert set(titles) == {"predator", "prey"}
    assert len(titles) == curves.count('class="chart')
