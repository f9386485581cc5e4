"""The first draft of a task for a log: sizes from its arrays and, for a Minari data set, its description."""

import re
from typing import Any

from lare_rl.assigner.layout import Layout
from lare_rl.logs.source import Source, open_logs
from lare_rl.new_task.documentation import plain, without_rewards
from lare_rl.new_task.draft import SCORE, Draft, bodies, entries, warning
from lare_rl.tasks.spec import NO_ENVIRONMENT

LIMIT = "# max_episode_steps = 1000 # episodes that did not terminate, and are shorter, were cut"


def draft_of_logs(source: Any) -> Draft:
    """A draft with all that a log says about itself.

    Raises:
        LareError: the log cannot be read.
    """
    logs = open_logs(source)
    described, left_out = without_rewards(plain(description_of(logs)))
    texts = {"description": described, "observation": "", "action": ""}
    layouts = {"observation": logs.form.observation, "action": logs.form.action}
    name = re.sub(r"[^\w.\-]+", "-", re.sub(r"\.parquet$", "", logs.name.rstrip("/")).rpartition("/")[2]) or "logs"
    limit = logs.form.limit
    lines = [
        *warning(left_out, "the log"),
        f'name = "{name}"',
        f'environment = "{NO_ENVIRONMENT}" # there are logs only; to train, the id of the environment that they come from',
        f"observation_size = {layouts['observation'].size}",
        f"action_size = {layouts['action'].size}",
        'judges = "after"',
        SCORE,
        f"max_episode_steps = {limit}" if limit else LIMIT,
        *bodies(texts, {key: head(layout, key) for key, layout in layouts.items()}),
    ]
    missing = tuple(key for key, text in texts.items() if not text)
    return Draft(name, "\n".join(lines) + "\n", missing, left_out, of_logs=True)


def description_of(logs: Source) -> str:
    """The description of a Minari data set; empty for other logs."""
    dataset = getattr(logs, "dataset", None)
    return "" if dataset is None else str(dataset.storage.metadata.get("description") or "")


def head(layout: Layout, key: str) -> str:
    """The first line of a text: how many entries there are, and which."""
    if layout.kind == "choices":
        return f"{entries(layout.size)}, all 0 but one: the {'action that is taken' if key == 'action' else 'state'}."
    if layout.kind == "named":
        parts = zip(layout.names, layout.parts, strict=True)
        return f"{entries(layout.size)}: " + ", then ".join(f"{part.size} of {name}" for name, part in parts) + "."
    return f"{entries(layout.size)}."
