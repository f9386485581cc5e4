"""The first draft of a task for a log: sizes from its layout and, if it has one, texts from its description."""

from pathlib import Path
from typing import Any

from lare_rl.assigner.space_layout import SpaceLayout
from lare_rl.logs.open_log import open_log
from lare_rl.new_task.documentation import single_agent_lines, split_sections, unused_titles, write_texts
from lare_rl.new_task.draft import SCORE_LINE, Draft, count_entries, file_name, head_lines, make_draft
from lare_rl.tasks.spec import NO_ENVIRONMENT

__all__ = ["draft_log_task"]

ENVIRONMENT_LINE = (
    '# environment: "none", because there are only logs. To train, write the id of the environment that they come from.'
)
LOG_LIMIT_LINE = (
    "# max_episode_steps = 1000 # the time limit, if there is one: shorter episodes that did not terminate then count as cut, and "
    "nothing is learned from them"
)


def draft_log_task(source: Any) -> Draft:
    """Draft a task from what a log contains. Raises `LareError` if the log cannot be read."""
    log = open_log(source)
    sections = split_sections(log.description)
    texts, removed = write_texts(single_agent_lines(sections), sections)
    path = Path(log.name).resolve()  # "." and ".." have no name of their own
    name = file_name(path.stem if path.suffix.lower() == ".parquet" else path.name) or "logs"
    layout, limit = log.layout, log.layout.max_episode_steps
    lines = [
        *head_lines(
            name,
            NO_ENVIRONMENT,
            (layout.observation.size, layout.action.size),
            removed,
            unused_titles(sections),
            origin="the log",
        ),
        ENVIRONMENT_LINE,
        SCORE_LINE,
        f"max_episode_steps = {limit}" if limit else LOG_LIMIT_LINE,
    ]
    space_descriptions = {
        "observation": _describe(layout.observation, "the number of the state"),
        "action": _describe(layout.action, "the action that is taken"),
    }
    return make_draft(name, lines, texts, space_descriptions, logs_only=True)


def _describe(layout: SpaceLayout, choice: str) -> str:
    """Return the number of entries, and what they are, as the first line of a text."""
    n_entries = count_entries(layout.size)
    match layout.kind:
        case "choices" if layout.shape:
            return f"{n_entries}: one-hot rows of {', '.join(map(str, layout.choices))} options, one behind the other."
        case "choices":
            first = f" (entry 0 is number {layout.first[0]})" if layout.first[0] else ""
            return f"{n_entries}, all 0 but one: {choice}{first}."
        case "dict" | "tuple":
            names = layout.names or [f"item {i}" for i in range(len(layout.inner))]
            inner = ", then ".join(f"{space.size} of {name}" for name, space in zip(names, layout.inner, strict=True))
            return f"{n_entries}: {inner}."
    return f"{n_entries}{f', an array of shape {layout.shape} row by row' if len(layout.shape) > 1 else ''}."
