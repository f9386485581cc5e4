"""Steps of a log that functions are tried on."""

import numpy as np
import pytest

import lare_rl
from helpers.logged import PHI, logged
from lare_rl import LareError
from lare_rl.latent.verify import verify


@pytest.mark.parametrize("judges", ["before", "after"])
def test_steps_are_from_all_over_the_log(task, judges):
    episodes = list(logged(40))
    observation, action = lare_rl.logged_steps(episodes, task.model_copy(update={"judges": judges}))
    assert (observation.shape, action.shape) == ((256, 2), (256, 1))
    known = slice(None, -1) if judges == "before" else slice(1, None)
    every = np.concatenate([one["observations"][known] for one in episodes])
    assert {row.tobytes() for row in observation} <= {row.tobytes() for row in every}


def test_both_observations_of_a_step_are_shown_if_both_are_judged(task):
    episodes = list(logged(40))
    observation, action = lare_rl.logged_steps(episodes, task.model_copy(update={"judges": "both"}))
    assert (observation.shape, action.shape) == ((256, 2), (256, 1))
    first, second = np.split(observation, 2)
    every = np.concatenate([one["observations"] for one in episodes])
    starts = {one["observations"][0].tobytes() for one in episodes}
    ends = {one["observations"][-1].tobytes() for one in episodes}
    assert {row.tobytes() for row in observation} <= {row.tobytes() for row in every}
    assert not ends & {row.tobytes() for row in first}
    assert not starts & {row.tobytes() for row in second}


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        (
            (np.zeros((3, 4)), np.zeros((3, 1))),
            "observations of steps must have the shape (n, 2), with the observation_size of Logs, and n >= 1 as for the other "
            "array: the shape is (3, 4)",
        ),
        ((np.zeros((3, 2)), np.full((3, 1), np.inf)), "actions of steps hold a number that is not finite"),
    ],
)
def test_steps_of_other_sizes_are_refused(task, steps, message):
    with pytest.raises(LareError) as error:
        verify(PHI, task, steps=steps)
    assert str(error.value) == message


def test_a_task_without_an_environment_takes_nothing_that_only_an_environment_hears(tmp_path, task):
    path = tmp_path / "task.toml"
    path.write_text(
        'name = "Logs"\nenvironment = "none"\nobservation_size = 2\naction_size = 1\ndescription = "d"\nobservation = "o"\n'
        'action = "a"\nmeasures = ["x"]\n'
    )
    with pytest.raises(LareError) as error:
        lare_rl.load_task(path)
    assert str(error.value) == "task 'Logs': measures makes no difference to logs: leave it out"
