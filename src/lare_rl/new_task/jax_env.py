"""Drafts the task file of an environment of another package in JAX: gymnax, Brax, MuJoCo Playground, Jumanji or JaxMARL."""

import inspect
import math
import re
import string
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from gymnasium.spaces import Box, Discrete

from lare_rl.envs.env_errors import NoTimeLimitError
from lare_rl.envs.families import FAMILIES
from lare_rl.envs.interface import EnvSpec
from lare_rl.envs.jaxmarl_env import JaxMARLEnv
from lare_rl.envs.jumanji_env import observed_arrays
from lare_rl.new_task import draft
from lare_rl.new_task.documentation import single_agent_lines, split_sections, write_texts
from lare_rl.new_task.draft import Draft, count_entries, file_name
from lare_rl.new_task.many_agents import make_stub, write_team_drafts

__all__ = ["draft_jax_task"]

SECTION_START = re.compile(
    r"^ ?- (observation|action|reward|episode termination|state)s?(?: \(if any\))?:", re.MULTILINE
)
"""The start of a section in Jumanji's documentation."""
MULTI_DISCRETE = re.compile(r"multi.?discrete.?array( \(\w+\))? of shape", re.IGNORECASE)
"""A line with the shape of an action of several choices. LaRe makes one choice of them, so the shape would mislead."""


def draft_jax_task(environment_id: str) -> Draft:
    """Draft a task file from an environment's documentation and sizes.

    Args:
        environment_id: family and name, such as `jumanji/Snake-v1`. The family must be registered.

    Raises:
        LareError: the environment cannot be made.
    """
    family, _, name = environment_id.partition("/")
    make: Callable[..., Any] = FAMILIES[family].load_maker()
    stub = make_stub(name, environment_id)
    limit: dict[str, int] = {}
    try:
        env = make(stub)
    except NoTimeLimitError:
        limit = {"max_episode_steps": draft.DEFAULT_LIMIT}
        env = make(stub.model_copy(update=limit))
    texts, removed = _read_texts(env)
    limit_lines = [draft.LIMIT_LINE] if limit else []
    if isinstance(env, JaxMARLEnv):
        env = make(make_stub(name, environment_id, env.layout.index, **limit))
        return write_team_drafts(file_name(name), environment_id, env, texts, removed, limit_lines)
    task_name, sizes = file_name(name), (env.spec.observation_size, env.spec.action_size)
    lines = [*draft.head_lines(task_name, environment_id, sizes, removed), draft.SCORE_LINE, *limit_lines]
    space_descriptions = {"observation": _describe_observation(env, family), "action": _describe_action(env.spec)}
    return draft.make_draft(task_name, lines, texts, space_descriptions)


def _read_texts(env: Any) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the texts by their keys, and the removed lines, from the docstring of the package's class."""
    documentation = inspect.cleandoc(type(env.env).__doc__ or "")
    sections = split_sections(SECTION_START.sub(_heading, documentation))
    lines = single_agent_lines(sections)
    rows = [line for line in _without_mask(lines["observation"]) if not line.startswith("Observation")]
    actions = [line for line in lines["action"] if not MULTI_DISCRETE.match(line)]
    return write_texts(lines | {"observation": rows, "action": actions}, sections)


def _without_mask(lines: list[str]) -> Iterator[str]:
    """Yield lines without the item about the mask of available actions, which is not in the observation."""
    in_mask = False
    for line in lines:
        in_mask = "action_mask" in line or (in_mask and not line.startswith("- "))
        if not in_mask:
            yield line


def _heading(match: re.Match[str]) -> str:
    """Return a section's heading in Markdown."""
    lead = "An episode ends:\n" if match[1] == "episode termination" else ""
    return f"## {match[1]}\n{lead}"


def _describe_observation(env: Any, family: str) -> str:
    """Return the number of entries and, if the observation has several arrays, which entries come from which."""
    count = count_entries(env.spec.observation_size)
    if family != "jumanji":
        return f"{count}."
    _, timestep = jax.eval_shape(env.env.reset, jnp.zeros(2, jnp.uint32))
    start, ranges = 0, []
    for name, array in observed_arrays(timestep.observation):
        entries = f"{start} to {start + array.size - 1}" if array.size > 1 else f"{start}"
        shape = f" (shape {' by '.join(map(str, array.shape))}, row by row)" if len(array.shape) > 1 else ""
        ranges.append(f"{entries}: {name}{shape}")
        start += array.size
    return f"{count}. {'; '.join(ranges)}."


def _describe_action(spec: EnvSpec) -> str:
    if spec.choice_sizes:
        return f"{count_entries(spec.action_size)}, all 0 but one: the combination of choices. {_describe_choices(spec.choice_sizes)}"
    space = Discrete(spec.action_size) if spec.discrete else Box(spec.low[0], spec.high[0])
    return f"{count_entries(spec.action_size)}{draft.describe_action(space)}."


def _describe_choices(sizes: tuple[int, ...]) -> str:
    """Return which entry stands for which combination of choices: the last choice changes first."""
    letters = string.ascii_lowercase[: len(sizes)]
    factors = [math.prod(sizes[i + 1 :]) for i in range(len(sizes))]
    entry = " + ".join(
        f"{factor} {letter}" if factor > 1 else letter
        for factor, letter, n in zip(factors, letters, sizes, strict=True)
        if n > 1
    )
    choices = [
        f"choice {i} is {letter}, from 0 to {n - 1}" if n > 1 else f"choice {i} is always 0"
        for i, (letter, n) in enumerate(zip(letters, sizes, strict=True), 1)
    ]
    return f"Entry {entry}: {'; '.join(choices)}."
