"""Games of TextWorld as a testbed: exact values, the policy gradient, features, and that the tables are the game's."""

import numpy as np
import pytest

from turns.text_games import HORIZON, TextGames
from turns.text_world import Command, ExploredGame, GameRules, make_game


def toy_game(seed):
    """Return a game where the lamp must be taken to the east. It cannot be lost, and going back is possible."""
    texts = ["a cellar", "an attic", "nothing", "a lamp", "taken", "an attic, empty", "won"]
    look = {0: (0, 2), 1: (1, 2), 2: (5, 3), 3: (0, 3)}
    moves = {
        0: [("go east", 1, 1)],
        1: [("go west", 0, 0), ("take lamp from shelf", 4, 2)],
        2: [("go west", 0, 3), ("put lamp on shelf", 4, 1)],
        3: [("go east", 5, 2), ("drop lamp", 6, 4)],
        4: [],
    }
    commands = [
        [
            *[Command(text, look[s][i], s) for i, text in enumerate(("look", "inventory")) if s in look],
            *[Command(text, result, following) for text, result, following in moves[s]],
        ]
        for s in moves
    ]
    rules = GameRules(seed, n_rooms=2, n_objects=2, quest_length=4)
    rooms = ["cellar", "attic", "attic", "cellar", "cellar"]
    return ExploredGame(rules, "Drop the lamp in the cellar.", texts, rooms, [s == 4 for s in moves], commands)


@pytest.fixture
def task():
    return TextGames([toy_game(0), toy_game(1)], n_training=2)


@pytest.fixture
def theta(task):
    return np.random.default_rng(0).normal(size=task.policy_shape)


def test_exact_success_is_that_of_rollouts(task, theta):
    rollouts = task.play(0.3 * theta, np.random.default_rng(1), n_groups=300)
    error = np.sqrt(rollouts.outcome.var() / len(rollouts.outcome))
    assert 0.05 < rollouts.outcome.mean() < 0.95
    assert rollouts.outcome.mean() == pytest.approx(task.success_rate(0.3 * theta), abs=4 * error)


def test_gradient_points_to_more_success(task, theta):
    theta = 0.3 * theta
    rollouts = task.play(theta, np.random.default_rng(1), n_groups=2000)
    gradient = task.gradient(theta, rollouts, task.truth(theta, rollouts).advantage)
    step = 1e-4 * gradient / np.linalg.norm(gradient)
    change = (task.success_rate(theta + step) - task.success_rate(theta - step)) / 2e-4
    assert change == pytest.approx(np.linalg.norm(gradient), rel=0.1)


def test_changes_of_exact_value_add_up(task, theta):
    rollouts = task.play(theta, np.random.default_rng(2), n_groups=4)
    truth = task.truth(theta, rollouts)
    # A rollout that is cut off has the value 0 at its end.
    np.testing.assert_allclose(truth.change.sum(axis=1), rollouts.outcome - truth.value[:, 0], atol=1e-12)


@pytest.mark.filterwarnings("ignore:Game .* is not fully supported")
def test_a_game_of_textworld_is_explored(tmp_path):
    """A random walk in TextWorld itself meets the commands and the ends of the tables."""
    textworld = pytest.importorskip("textworld")
    rules = GameRules(2, n_rooms=3, n_objects=3, quest_length=3)
    game = make_game(rules, tmp_path)
    assert game is not None
    assert any(game.won)
    infos = textworld.EnvInfos(admissible_commands=True, won=True)
    environment = textworld.start(str(tmp_path / "game-2.z8"), infos)
    random = np.random.default_rng(0)
    observed, state = environment.reset(), 0
    for _ in range(3 * HORIZON):
        assert sorted(observed.admissible_commands) == [command.text for command in game.commands[state]]
        command = game.commands[state][random.integers(len(game.commands[state]))]
        observed, _, _ = environment.step(command.text)
        state = command.next_state
        assert game.texts[command.result] in observed.feedback
        assert observed.won == game.won[state]
        if game.won[state]:
            observed, state = environment.reset(), 0
    environment.close()
