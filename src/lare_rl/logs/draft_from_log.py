"""The first draft of a task for a log: sizes from its arrays and, for a Minari data set, its description."""

from pathlib import Path
from typing import Any

from lare_rl.assigner.space_layout import SpaceLayout
from lare_rl.logs.open_log import open_log
from lare_rl.new_task.documentation import plain_lines, remove_rewards
from lare_rl.new_task.draft import SCORE_LINE, Draft, count_entries, file_name, head_lines, make_draft
from lare_rl.tasks.spec import NO_ENVIRONMENT

__all__ = ["draft_log_task"]

ENVIRONMENT_LINE = "# environment: there are logs only; to train, the id of the environment that they come from"
LIMIT_LINE = "# max_episode_steps = 1000 # episodes that did not terminate, and are shorter, were cut"


def draft_log_task(source: Any) -> Draft:
    """Draft a task from what a log contains. Raises `LareError` if the log cannot be read."""
    log = open_log(source)
    dataset = getattr(log, "dataset", None)  # only a Minari data set has a description
    text = "" if dataset is None else str(dataset.storage.metadata.get("description") or "")
    description, removed = remove_rewards(plain_lines(text))
    texts = {"description": description, "observation": "", "action": ""}
    layouts = {"observation": log.layout.observation, "action": log.layout.action}
    name = file_name(Path(log.name).name.removesuffix(".parquet")) or "logs"
    sizes, limit = (log.layout.observation.size, log.layout.action.size), log.layout.max_episode_steps
    lines = [
        *head_lines(name, NO_ENVIRONMENT, sizes, removed, origin="the log"),
        ENVIRONMENT_LINE,
        SCORE_LINE,
        f"max_episode_steps = {limit}" if limit else LIMIT_LINE,
    ]
    first_lines = {key: _first_line(layout, key) for key, layout in layouts.items()}
    return make_draft(name, lines, texts, first_lines, logs_only=True)


def _first_line(layout: SpaceLayout, key: str) -> str:
    """Return the first line of the text of a key: the number of entries, and what they are."""
    n_entries = count_entries(layout.size)
    if layout.kind == "choices" and len(layout.choices) > 1:
        return f"{n_entries}: one-hot rows of {', '.join(map(str, layout.choices))} options, one behind the other."
    if layout.kind == "choices":
        return f"{n_entries}, all 0 but one: the {'action that is taken' if key == 'action' else 'state'}."
    if layout.kind == "dict":
        children = zip(layout.names, layout.inner, strict=True)
        return f"{n_entries}: " + ", then ".join(f"{child.size} of {name}" for name, child in children) + "."
    return f"{n_entries}."
