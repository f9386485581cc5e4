"""Steps and episodes of a log, and the first task file of a log."""

import numpy as np
import pytest

import lare_rl
from helpers.toy_logs import logged_episodes
from lare_rl import LareError
from lare_rl.logs import steps
from lare_rl.logs.draft_from_log import draft_log_task


def distinct(rows):
    return {row.tobytes() for row in rows}


@pytest.mark.parametrize("scored_observation", ["before", "after", "both"])
def test_logged_steps(task, scored_observation):
    log = list(logged_episodes(40))
    task = task.model_copy(update={"scored_observation": scored_observation})
    observation, action = lare_rl.logged_steps(log, task)
    assert (observation.shape, action.shape) == ((256, 2), (256, 1))
    first, second = np.split(observation, 2)
    before = distinct(row for episode in log for row in episode["observations"][:-1])
    after = distinct(row for episode in log for row in episode["observations"][1:])
    assert distinct(first) <= (after if scored_observation == "after" else before)
    assert distinct(second) <= (before if scored_observation == "before" else after)


def test_logged_episodes_are_complete(task):
    log = [episode | {"cut": number == 1} for number, episode in enumerate(logged_episodes(4))]
    episodes = steps.logged_episodes(log, task, 2)
    for episode, arrays in zip(episodes, (log[0], log[2]), strict=True):
        np.testing.assert_array_equal(episode.observation[:, 0], arrays["observations"][:-1])
        np.testing.assert_array_equal(episode.next_observation[:, 0], arrays["observations"][1:])
        np.testing.assert_array_equal(episode.env_action[:, 0], arrays["actions"])
        np.testing.assert_array_equal(episode.team_reward, arrays["rewards"])
        assert episode.reward.shape == episode.alive.shape == (len(arrays["rewards"]), 1)


def test_draft_log_task(folder, tmp_path):
    draft = draft_log_task(folder(logged_episodes(1)))
    assert (draft.name, draft.missing_keys, draft.logs_only) == ("log", ("description", "observation", "action"), True)
    (tmp_path / "task.toml").write_text(draft.toml)
    task = lare_rl.load_task(tmp_path / "task.toml")
    assert (task.observation_size, task.action_size, task.environment) == (2, 1, "none")
    (tmp_path / "task.toml").write_text(draft.toml + 'measures = ["x"]\n')
    with pytest.raises(LareError, match="measures"):
        lare_rl.load_task(tmp_path / "task.toml")
