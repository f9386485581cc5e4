"""The first task file of a log."""

import lare_rl
from helpers.toy_logs import logged_episodes
from lare_rl.logs.draft_from_log import draft_log_task


def test_draft_log_task(folder, tmp_path):
    draft = draft_log_task(folder(logged_episodes(1)))
    assert (draft.name, draft.missing_keys, draft.logs_only) == ("log", ("description", "observation", "action"), True)
    (tmp_path / "task.toml").write_text(draft.toml.replace("FILL IN", "Filled in"))
    task = lare_rl.load_task(tmp_path / "task.toml")
    assert (task.observation_size, task.action_size, task.environment) == (2, 1, "none")
