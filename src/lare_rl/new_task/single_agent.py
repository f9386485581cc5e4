"""Drafts the task file of an environment: sizes from its spaces, texts from its documentation, without the rewards."""

import contextlib

import gymnasium
from gymnasium.spaces import flatdim

from lare_rl.envs.families import FAMILIES
from lare_rl.envs.gymnasium_env import make_gymnasium
from lare_rl.errors import LareError
from lare_rl.new_task import draft
from lare_rl.new_task.documentation import single_agent_lines, split_sections, unused_titles, write_texts
from lare_rl.new_task.draft import Draft, count_entries, file_name
from lare_rl.tasks.spec import PETTINGZOO_PREFIX, split_environment

__all__ = ["draft_task"]


def draft_task(environment_id: str) -> Draft:
    """Draft a task file from an environment's documentation and spaces.

    Raises `LareError` if the environment cannot be made, its spaces cannot be flattened, or its family has no drafts.
    """
    if environment_id.startswith(PETTINGZOO_PREFIX):
        from lare_rl.new_task.many_agents import draft_multi_agent_task

        return draft_multi_agent_task(environment_id)
    family, slash, _ = environment_id.partition("/")
    if slash and family in ("gymnax", "brax", "playground", "jumanji", "jaxmarl"):
        from lare_rl.new_task.jax_env import draft_jax_task

        return draft_jax_task(environment_id)
    if slash and family in FAMILIES:
        raise LareError(f"new-task cannot draft a task of {family}: write its file by hand (docs/reference/tasks.md)")
    with contextlib.closing(make_gymnasium(environment_id)) as env:
        return _write_draft(environment_id, env)


def _write_draft(environment_id: str, env: gymnasium.Env) -> Draft:
    # Not inspect.getdoc: it would return the docstring of a base class, which does not describe this environment.
    sections = split_sections(type(env.unwrapped).__doc__ or "")
    texts, removed = write_texts(single_agent_lines(sections), sections)
    observation_size, action_size = (int(flatdim(space)) for space in (env.observation_space, env.action_space))
    space_descriptions = {
        "observation": f"{count_entries(observation_size)}{draft.describe_flattening(env.observation_space)}.",
        "action": f"{count_entries(action_size)}{draft.describe_action(env.action_space)}.",
    }
    # An id without a version means the latest version, which may change later.
    _, name = split_environment(environment_id)
    full_id = environment_id.removesuffix(name) + env.spec.id if env.spec else environment_id
    sizes = observation_size, action_size
    lines = [
        *draft.head_lines(file_name(name), full_id, sizes, removed, unused_titles(sections)),
        draft.SCORE_LINE,
        draft.MEASURES_LINE,
        draft.GROUP_LINE,
        *([] if env.spec and env.spec.max_episode_steps else [draft.LIMIT_LINE]),
    ]
    return draft.make_draft(file_name(name), lines, texts, space_descriptions)
