"""What runs of many agents look like from outside."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lare_rl
from lare_rl.envs.families import make_env
from lare_rl.envs.interface import Team
from lare_rl.errors import LareError
from lare_rl.evaluation import team_matches as agents
from lare_rl.evaluation.evaluate import evaluate_run
from lare_rl.evaluation.video import record_video
from lare_rl.evaluation.watch import watch
from lare_rl.training.collect_device import play
from lare_rl.training.compiled import module_of
from lare_rl.training.session import load_learner


@pytest.fixture(scope="module")
def runs(tmp_path_factory, small_many):
    """Two runs with two teams, and one with a single one."""
    place = tmp_path_factory.mktemp("runs")
    return [
        lare_rl.train(task, small_many(method=method, steps=200, seed=seed), out=place / str(seed), listeners=[])
        for seed, (task, method) in enumerate(
            [("CompetitivePP-6", "lare-rd"), ("CompetitivePP-6", "dense"), ("TriangleArea", "rd")]
        )
    ]


def test_an_episode_is_watched(runs):
    watched = watch(runs[0])
    assert watched.state.world.position.shape == (25, 1, 11, 2)
    assert watched.reward.shape == watched.proxy.shape == watched.credit.shape == (25, 1, 8)
    assert watched.proxy.std() > 0
    assert watched.of_episode(watched.reward).shape == (25, 8)
    assert [picture.shape for picture in agents.frames(runs[0], watched)] == [(400, 400, 3)] * 25
    without = watch(runs[1])
    assert without.proxy is None
    np.testing.assert_array_equal(without.credit, without.reward)


def test_samples_of_each_team(runs):
    predators, preys = agents.sample(runs[0])
    rows = agents.SAMPLED * 25
    assert (predators.observation.shape, preys.observation.shape) == ((6 * rows, 24), (2 * rows, 24))
    for sample, function in zip((predators, preys), runs[0].functions, strict=True):
        assert sample.factors.shape == (len(sample.reward), function.size)
        assert sample.correlations.shape == (function.size,)
        assert np.nanmax(np.abs(sample.correlations)) > 0.3
    assert agents.sample(runs[1])[0].factors.shape == (6 * rows, 0)


def test_random_actions_are_not_the_policys(runs):
    learned, random = agents.sample(runs[2]), agents.sample(runs[2], random=True)
    assert not np.array_equal(learned[0].observation, random[0].observation)


def test_true_returns_by_team(runs):
    found = evaluate_run(runs[0], 6)
    assert list(found) == ["CompetitivePP-6-predator", "CompetitivePP-6-prey"]
    assert all(values.shape == (2, 6) for values in found.values())
    assert list(evaluate_run(runs[2], 3)) == ["TriangleArea"]


def test_cross_play_is_every_team_against_every_other(runs):
    matches = agents.cross_play((runs[0], runs[1]), episodes=4)
    assert [(match.first, match.others) for match in matches] == [
        (one, other) for one in runs[:2] for other in runs[:2]
    ]
    assert all(match.returns.shape == (2, 2) and np.isfinite(match.returns).all() for match in matches)
    # The same predators from the same starts, but other preys.
    assert not np.array_equal(matches[0].returns, matches[1].returns)


def test_a_pair_is_the_first_team_of_one_seed_and_the_others_of_another(runs):
    """Where both policies are one, it is simply played."""
    config, learner, *_ = load_learner(runs[0])
    env, team = make_env(runs[0].config.task), config.env.teams[0]
    matches = agents.cross_play((runs[0], runs[1]), episodes=40)
    for seed in range(2):
        one = jax.tree.map(lambda leaf, seed=seed: leaf[seed : seed + 1], learner)
        actor = module_of(config).actor(one, 200, config)
        played = jax.jit(partial(play, env, count=40, config=config, greedy=False))(actor, jax.random.key(0)[None])
        alone = played.steps.after.reward[..., team.agents].mean(axis=-1).sum(axis=0).mean()
        np.testing.assert_allclose(matches[0].returns[seed, seed], alone, rtol=1e-4)
    assert len({match.returns[0, 1] for match in matches}) == 4


def test_who_leads_whom():
    def act(actor, memory, *shown):
        return jnp.full((1, 3, 8, 5), actor), memory

    actions, _ = agents.led_by_two((1.0, 4.0), (), act=act, team=Team("first", 0, 6))
    np.testing.assert_array_equal(actions[0, :, :, 0], np.tile([1.0] * 6 + [4.0] * 2, (3, 1)))


def test_cross_play_needs_two_teams_of_one_task(runs):
    message = "cross-play needs two runs of one task in which two teams learn, and these are of "
    with pytest.raises(LareError) as error:
        agents.cross_play((runs[2], runs[2]))
    assert str(error.value) == f"{message}TriangleArea"
    with pytest.raises(LareError) as error:
        agents.cross_play((runs[0], runs[2]))
    assert str(error.value) == f"{message}CompetitivePP-6, TriangleArea"


def test_cross_play_on_the_command_line(runs, command):
    status, out, err = command("cross-play", runs[0].directory, runs[1].directory, "--episodes", 3)
    assert (status, err) == (0, "")
    assert out.count(" ± ") == 5  # four, and the line that says what they are
    assert out.startswith("predator of, against prey of")
    assert out.endswith("over all pairs of a seed of one run and a seed of the other, 3 episodes each.\n")
    status, out, err = command("cross-play", runs[0].directory, runs[2].directory)
    assert (status, out) == (2, "")
    assert err.startswith("lare-rl: cross-play needs two runs of one task in which two teams learn, and these are of ")


def test_evaluate_on_the_command_line(runs, command, tmp_path):
    status, out, err = command("evaluate", runs[0].directory, "--episodes", 3, "--video", "film.gif")
    assert (status, err) == (0, "")
    first, *lines, last = out.splitlines()
    assert last == "The policy samples its actions, as in training; --deterministic plays the most likely ones."
    assert [line.split(": ")[0] for line in lines] == [
        f"CompetitivePP-6-{team}, seed {seed}" for team in ("predator", "prey") for seed in runs[0].seeds
    ]
    assert first == "wrote film.gif"
    assert (tmp_path / "film.gif").exists()


def test_a_film_of_a_run(runs, tmp_path):
    record_video(runs[0], tmp_path / "film.gif")
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF8")


def test_the_report(runs, tmp_path, monkeypatch):
    monkeypatch.setattr("lare_rl.report.agents_report.PICTURED", 100)
    page = lare_rl.write_report([run.directory for run in runs], tmp_path / "report.html").read_text()
    assert page.count("data:image/gif;base64,") == 3
    for heading in (
        "The factors of CompetitivePP-6-predator",
        "The latent function of CompetitivePP-6-prey",
        "True return, team of prey",
        "Correlation of proxy and true reward, team of predator",
        "Who got which credit when",
    ):
        assert heading in page
    assert page.count("t-SNE of steps of agents") == 2
    assert ">nan<" not in page
