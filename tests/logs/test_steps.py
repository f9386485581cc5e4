"""Steps of a log on which functions are tried."""

import numpy as np
import pytest

import lare_rl
from helpers.toy_logs import PHI, logged_episodes
from lare_rl import LareError
from lare_rl.latent.verify import verify


def distinct(rows):
    return {row.tobytes() for row in rows}


@pytest.mark.parametrize("judges", ["before", "after", "both"])
def test_logged_steps(task, judges):
    episodes = [episode["observations"] for episode in logged_episodes(40)]
    observation, action = lare_rl.logged_steps(list(logged_episodes(40)), task.model_copy(update={"judges": judges}))
    assert (observation.shape, action.shape) == ((256, 2), (256, 1))
    first, second = np.split(observation, 2)
    before = distinct(row for episode in episodes for row in episode[:-1])
    after = distinct(row for episode in episodes for row in episode[1:])
    assert distinct(first) <= (after if judges == "after" else before)
    assert distinct(second) <= (before if judges == "before" else after)


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ((np.zeros((3, 4)), np.zeros((3, 1))), r"observations .*\(n, 2\)"),
        ((np.zeros((3, 2)), np.full((3, 1), np.inf)), "actions .*not finite"),
    ],
)
def test_bad_steps(task, steps, message):
    with pytest.raises(LareError, match=message):
        verify(PHI, task, steps=steps)


def test_task_without_environment_has_no_measures(tmp_path):
    path = tmp_path / "task.toml"
    path.write_text(
        'name = "Logs"\nenvironment = "none"\nobservation_size = 2\naction_size = 1\ndescription = "d"\nobservation = "o"\n'
        'action = "a"\nmeasures = ["x"]\n'
    )
    with pytest.raises(LareError, match="measures"):
        lare_rl.load_task(path)
