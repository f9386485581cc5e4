"""One episode of a log. No log is trusted: a value that does not fit raises a `LareError` that names the file and the key."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.assigner.group_names import GroupName, to_group_name
from lare_rl.assigner.space_layout import SpaceLayout, check_numbers, to_array
from lare_rl.errors import LareError, short_repr
from lare_rl.tasks.spec import TaskSpec

__all__ = ["KEYS", "LogLayout", "LoggedEpisode", "RelabelledEpisode", "infer_layout", "parse_episode"]

KEYS = (
    "observations", "actions", "rewards", "score", "next_observations", "terminations", "truncations", "cut", "paid", "group",
)  # fmt: skip
"""The arrays of an episode that are read. The key `paid` has the rewards before the log was relabelled."""


@dataclass(frozen=True)
class LoggedEpisode:
    """An episode of T steps."""

    name: str
    """The file, or the number of the episode in its log, for messages."""
    observation: Float[np.ndarray, "steps observation"]
    action: Float[np.ndarray, "steps action"]
    next_observation: Float[np.ndarray, "steps observation"]
    reward: Float[np.ndarray, " steps"]
    """The original reward of each step. A score is the reward of the last step."""
    is_score: bool
    """Whether the log has the episode's score, and not its rewards."""
    complete: bool
    """Whether the episode was played to its end. Only then is its return known."""
    group: GroupName | None
    """The group of the episode, such as its map. None if the log has none."""
    contents: Any = field(repr=False)
    """The episode as it was read, to write it again: a mapping of arrays, or a table."""

    def __len__(self) -> int:
        return len(self.reward)


class RelabelledEpisode(NamedTuple):
    """An episode and its proxy rewards."""

    episode: LoggedEpisode
    r_hat: Float[np.ndarray, " steps"]


@dataclass(frozen=True)
class LogLayout:
    """The layout that all episodes of a log share."""

    observation: SpaceLayout
    action: SpaceLayout
    max_episode_steps: int | None = None
    """The time limit; None if it is unknown."""
    has_groups: bool = False
    """Whether episodes have a `group`."""


def infer_layout(name: str, values: Mapping[str, Any], role: TaskSpec | None) -> LogLayout:
    """Infer the layout of a log without spaces from its first episode.

    Args:
        role: the task of the log: the sizes of one-hot observations and actions, and the time limit.

    Raises:
        LareError: actions or observations are whole numbers, and the number of choices is unknown.
    """
    sizes = {} if role is None else {"observation": role.observation_size, "action": role.action_size}
    layouts = {}
    for kind in ("observation", "action"):
        array = to_array(values.get(f"{kind}s", np.zeros((0, 0))), f"{name}: {kind}s")
        # As replay buffers store choices. Without a task, an observation of one whole number is a number.
        is_column = array.ndim == 2 and array.shape[1] == 1 and (kind == "action" or sizes.get(kind, 1) != 1)
        is_discrete = array.dtype.kind in "iu" and (array.ndim == 1 or is_column)
        if is_discrete and kind not in sizes:
            raise LareError(
                f"{name}: {kind}s are whole numbers, and the number of choices is unknown: write a task file by hand that has it "
                f"({kind}_size; docs/reference/logs.md), for --task. If they are no choices, write them as floating-point numbers"
            )
        if is_discrete and sizes[kind] != 1:
            shape = (1,) if is_column else ()
            layouts[kind] = SpaceLayout(kind="choices", shape=shape, choices=(sizes[kind],), first=(0,))
        else:
            layouts[kind] = SpaceLayout(kind="numbers", shape=array.shape[1:])
            if array.size and kind in sizes and layouts[kind].size != sizes[kind]:
                raise LareError(
                    f"{name}: {kind}s have rows of {layouts[kind].size} numbers, and the task has {kind}_size = {sizes[kind]}; choices "
                    "must be whole numbers from 0, of the shape (T,) or (T, 1)"
                )
    max_episode_steps = None if role is None else role.max_episode_steps
    return LogLayout(**layouts, max_episode_steps=max_episode_steps, has_groups="group" in values)


def parse_episode(name: str, values: Mapping[str, Any], layout: LogLayout, contents: Any) -> LoggedEpisode:
    """Check the arrays of an episode and bring them into rows.

    Args:
        name: name of the file, or of the episode in it.
        values: `observations` (T + 1, ...) or, with `next_observations` (T, ...), (T, ...); `actions` (T, ...); `rewards` (T,) or
            `score`, a single number. Optional: `terminations`, `truncations` and `cut`, (T,) or one flag; `paid` (T,), the
            rewards before the log was relabelled; `group`, a text or a number, or (T,) of them.
        contents: what to write again, with new rewards.

    Raises:
        LareError: an array is missing, has another shape or type, or holds a number that is not finite.
    """
    for key in ("observations", "actions"):
        if key not in values:
            raise LareError(f"{name} has no {key}: an episode needs observations, actions, and rewards or a score")
    action = _rows(f"{name}: actions", values["actions"], layout.action)
    observation = _rows(f"{name}: observations", values["observations"], layout.observation)
    n_steps = len(action)
    if not n_steps:
        raise LareError(f"{name}: actions has no step")
    if "next_observations" in values:
        next_observation = _rows(f"{name}: next_observations", values["next_observations"], layout.observation)
        if not len(observation) == len(next_observation) == n_steps:
            raise LareError(
                f"{name}: observations and next_observations need {n_steps} rows, one for each action, and have "
                f"{len(observation)} and {len(next_observation)}"
            )
    else:
        if len(observation) != n_steps + 1:
            raise LareError(
                f"{name}: observations needs {n_steps + 1} rows, one more than actions, and has {len(observation)}: add the last "
                "observation, or next_observations"
            )
        observation, next_observation = observation[:-1], observation[1:]
    return LoggedEpisode(
        name=name,
        observation=observation,
        action=action,
        next_observation=next_observation,
        reward=_original_reward(name, values, n_steps),
        is_score="score" in values,
        complete=_is_complete(name, values, n_steps, layout.max_episode_steps),
        group=_group(name, values, n_steps),
        contents=contents,
    )


def _rows(where: str, values: Any, layout: SpaceLayout) -> Float[np.ndarray, "steps size"]:
    rows = layout.rows(values, where)
    check_numbers(rows, where)
    if rows.ndim != 2:
        raise LareError(f"{where} must have rows of {layout.size} numbers, and its shape is {rows.shape}")
    return rows


def _original_reward(name: str, values: Mapping[str, Any], n_steps: int) -> Float[np.ndarray, " steps"]:
    """Return the rewards of an episode: those before it was relabelled, if it was."""
    key = next((key for key in ("paid", "score", "rewards") if key in values), None)
    if key is None:
        raise LareError(f"{name} has no rewards and no score: an episode needs observations, actions, and one of these")
    where = f"{name}: {key}"
    reward = to_array(values[key], where)
    check_numbers(reward, where)
    shape = () if key == "score" else (n_steps,)
    if reward.shape != shape:
        expected = f"have one number for each of {n_steps} steps" if shape else "be a single number"
        raise LareError(f"{where} must {expected}, and its shape is {reward.shape}")
    reward = reward.astype(np.float64)
    check_numbers(np.asarray(np.abs(reward).sum()), f"{where}: the sum of absolute values")
    return reward if shape else np.append(np.zeros(n_steps - 1), reward)


def _group(name: str, values: Mapping[str, Any], n_steps: int) -> GroupName | None:
    """Return the group of an episode. If there is one for each step, it is that of the last step."""
    if "group" not in values:
        return None
    groups = np.asarray(values["group"], object)
    group = groups.ravel()[-1] if groups.shape in ((), (1,), (n_steps,)) else values["group"]
    return to_group_name(group, f"{name}: group")


def _is_complete(name: str, values: Mapping[str, Any], n_steps: int, max_episode_steps: int | None) -> bool:
    """Return whether an episode terminated, or the time limit ended it.

    If the time limit is unknown, every truncation counts as the time limit. Without any flags, every episode is complete.
    """
    terminated, truncated = (_last_flag(name, key, values, n_steps) for key in ("terminations", "truncations"))
    if _last_flag(name, "cut", values, n_steps):
        return False
    if terminated or (terminated is None and truncated is None):
        return True
    return bool(truncated) if max_episode_steps is None else n_steps >= max_episode_steps


def _last_flag(name: str, key: str, values: Mapping[str, Any], n_steps: int) -> bool | None:
    """Return the flag of the last step, or None without flags. `cut` is true if any of its flags is."""
    if key not in values:
        return None
    flags = to_array(values[key], f"{name}: {key}")
    if not np.isin(flags, (0, 1)).all():
        raise LareError(f"{name}: {key} must be true or false, and is {short_repr(flags)}")
    if flags.shape not in ((), (1,), (n_steps,)):
        raise LareError(f"{name}: {key} must have one flag for each of {n_steps} steps, and its shape is {flags.shape}")
    flags = np.atleast_1d(flags).astype(bool)
    if key == "cut":
        return bool(flags.any())
    if flags[:-1].any():
        raise LareError(f"{name}: {key} ends the episode at step {int(flags.argmax()) + 1} of {n_steps}")
    return bool(flags[-1])
