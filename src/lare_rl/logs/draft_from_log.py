"""The first draft of a task for a log: sizes from its layout and, if it has one, texts from its description."""

from pathlib import Path
from typing import Any

from lare_rl.assigner.space_layout import SpaceLayout
from lare_rl.logs.open_log import open_log
from lare_rl.new_task.documentation import single_agent_lines, split_sections, unused_titles, write_texts
from lare_rl.new_task.draft import (
    ACTION,
    DEFAULT_LIMIT,
    SCORE_LINE,
    STATE,
    Draft,
    count_entries,
    describe_choice,
    describe_shape,
    file_name,
    head_lines,
    make_draft,
)
from lare_rl.tasks.spec import NO_ENVIRONMENT

__all__ = ["draft_log_task"]

ENVIRONMENT_LINE = (
    f'# environment: "{NO_ENVIRONMENT}", because there are only logs. To train, write the id of the environment that they come '
    "from."
)
LOG_LIMIT_LINE = (
    f"# max_episode_steps = {DEFAULT_LIMIT} # the time limit, if there is one. If it is set and the log has flags, an episode that is "
    "shorter and did not terminate counts as cut, and nothing is learned from it"
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
        "observation": _describe(layout.observation, STATE),
        "action": _describe(layout.action, ACTION),
    }
    return make_draft(name, lines, texts, space_descriptions, logs_only=True)


def _describe(layout: SpaceLayout, choice: str) -> str:
    """Return the number of entries, and what they are, as the first line of a text."""
    n_entries = count_entries(layout.size)
    match layout.kind:
        case "choices" if layout.shape:
            options = (
                f"{n} options from number {first}" for n, first in zip(layout.choices, layout.first, strict=True)
            )
            return f"{n_entries}: a one-hot row for each choice, one behind the other: {', then '.join(options)}."
        case "choices":
            return f"{n_entries}{describe_choice(choice, layout.first[0])}."
        case "dict" | "tuple":
            names = layout.names or [f"item {i}" for i in range(len(layout.inner))]
            inner = ", then ".join(f"{space.size} of {name}" for name, space in zip(names, layout.inner, strict=True))
            return f"{n_entries}: {inner}."
    return f"{n_entries}{describe_shape(layout.shape)}."
