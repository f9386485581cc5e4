"""Drafts a spec for any environment: sizes from its spaces, texts from its documentation, without the rewards."""

import itertools
import re

import gymnasium

from lare_rl.envs.guarded_gymnasium import make
from lare_rl.envs.spaces import OneHot
from lare_rl.errors import LareError
from lare_rl.new_task.documentation import ENDINGS, ending, plain, sections_of, without_rewards
from lare_rl.new_task.draft import JUDGES, MEASURES, SCORE, Draft, bodies, bounds, entries, flattened, warning
from lare_rl.tasks.spec import PETTINGZOO

TITLES = {
    "description": ("", "description"),
    "observation": ("observation space", "observation"),
    "action": ("action space", "action"),
}
"""The sections that a text is taken from; "" is the text above the first title."""


def draft(environment_id: str) -> Draft:
    """Draft a spec from an environment's documentation and spaces.

    Raises:
        LareError: the environment cannot be made, or its spaces cannot be represented as rows of numbers.
    """
    if environment_id.startswith(PETTINGZOO):
        from lare_rl.new_task.many_agents import draft_of_agents

        return draft_of_agents(environment_id)
    environment = make(environment_id)
    try:
        for what, space in (("observation", environment.observation_space), ("action", environment.action_space)):
            if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
                raise LareError(f"the {what} space of {environment_id} is {space}, which is {instead(what)}")
        return write(environment_id, environment)
    finally:
        environment.close()


def instead(what: str) -> str:
    """The kinds of space that can be used, for a message."""
    if what == "observation":
        return "no row of numbers"
    return (
        "neither one row of bounded numbers (Box) nor one choice (Discrete): of several choices, make one choice of all their "
        "combinations, or numbers that the environment rounds"
    )


def write(environment_id: str, environment: gymnasium.Env) -> Draft:
    sections = documented(environment.unwrapped)
    raw = environment.unwrapped
    observation_size, action_size = environment.observation_space.shape[0], environment.action_space.shape[0]  # type: ignore[index]
    texts: dict[str, str] = {}
    left_out: tuple[str, ...] = ()
    for key, titles in TITLES.items():
        found = [sections[title] for title in titles if sections.get(title, "").strip()]
        # A summary may stand above the description; of other texts, only the first is taken.
        texts[key], dropped = without_rewards(plain("\n\n".join(found if key == "description" else found[:1])))
        left_out += dropped
    if texts["description"]:
        texts["description"] += ending(sections)
    heads = {
        "observation": f"{entries(observation_size)}{flattened(raw.observation_space)}.",
        "action": f"{entries(action_size)}{chosen(environment.action_space)}{bounds(environment.action_space)}.",
    }
    missing = tuple(key for key in texts if not texts[key])
    # An id without a version means the latest version, which may change later.
    module, colon, _ = environment_id.rpartition(":")
    full_id = f"{module}{colon}{environment.spec.id}" if environment.spec else environment_id
    name = re.sub(r"[^\w.\-]+", "-", environment_id.rpartition(":")[2])
    limit = environment.spec.max_episode_steps if environment.spec else None
    used = {*itertools.chain(*TITLES.values()), *ENDINGS}
    unused = tuple(title for title, body in sections.items() if title not in used and body.strip())
    lines = [
        *warning(left_out, unused=unused),
        f'name = "{name}"',
        f'environment = "{full_id}"',
        f"observation_size = {observation_size}",
        f"action_size = {action_size}",
        JUDGES,
        SCORE,
        MEASURES,
        *(
            []
            if limit
            else [
                "max_episode_steps = 1000 # the environment has no limit of its own: write the length of its longest episode, or "
                "more (longer episodes are cut)"
            ]
        ),
        *bodies(texts, heads),
    ]
    return Draft(name, "\n".join(lines) + "\n", missing, left_out, unused=unused)


def documented(environment: gymnasium.Env) -> dict[str, str]:
    """The sections of an environment's documentation, which is the docstring of its class."""
    # Not inspect.getdoc: it would return the docstring of a base class, which does not describe this environment.
    return sections_of(type(environment).__doc__ or "")


def chosen(space: gymnasium.Space) -> str:
    return ", all 0 but one: the action that is taken" if isinstance(space, OneHot) else ""
