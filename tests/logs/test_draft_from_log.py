"""A first task file of a log."""

import lare_rl
from helpers.logged import logged
from lare_rl.logs.draft_from_log import draft_of_logs


def test_sizes_are_those_of_the_arrays(folder, tmp_path):
    drafted = draft_of_logs(folder(logged(1)))
    assert (drafted.name, drafted.missing, drafted.of_logs) == ("log", ("description", "observation", "action"), True)
    (tmp_path / "task.toml").write_text(drafted.toml.replace("FILL IN", "Filled in"))
    task = lare_rl.load_task(tmp_path / "task.toml")
    assert (task.observation_size, task.action_size, task.environment) == (2, 1, "none")
