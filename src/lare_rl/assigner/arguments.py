"""The arrays that a `CreditAssigner` is given: they are checked, and become rows of numbers."""

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.assigner.assigner_config import AssignerConfig
from lare_rl.envs.interface import alive_mean
from lare_rl.errors import LareError, short_repr
from lare_rl.tasks.payments import PaymentRule
from lare_rl.tasks.spec import MAX_LEVELS

__all__ = [
    "GroupName",
    "NewSteps",
    "read_episode",
    "read_steps",
    "to_flags",
    "to_lengths",
    "to_levels",
    "to_rows",
    "to_step_ids",
]


GroupName = str | int | float
"""The name of a group."""


class NewSteps(NamedTuple):
    """The valid rows of a call of `CreditAssigner.add`, or the steps of an episode."""

    rows: Int[np.ndarray, " steps"]
    """Their indices in the user's arrays."""
    n_rows: int
    """The number of rows of the user's arrays."""
    env_ids: list[Hashable]
    steps: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Observations, actions and next observations."""
    reward: Float[np.ndarray, " steps"]
    """The team's reward."""
    ended: Bool[np.ndarray, " steps"]
    alive: Bool[np.ndarray, "steps agents"] | None
    """Which agents acted. None means all."""


def read_steps(
    config: AssignerConfig,
    arrays: tuple[np.ndarray, np.ndarray, np.ndarray],
    reward: Any,
    terminated: Any,
    truncated: Any,
    env_ids: Sequence[Hashable] | None,
    valid: Any,
    alive: Any,
) -> NewSteps:
    """Return the valid rows of the arguments of `CreditAssigner.add`. Raises `LareError` if they do not fit together.

    `arrays` are the steps as `to_rows` returns them.
    """
    n_rows = len(arrays[0])
    team_reward, alive = _to_team_reward(config, reward, alive, n_rows)
    ended = to_flags(terminated, "terminated", n_rows) | to_flags(truncated, "truncated", n_rows)
    rows = np.flatnonzero(np.ones(n_rows, bool) if valid is None else to_flags(valid, "valid", n_rows))
    ids = range(n_rows) if env_ids is None else env_ids
    if len(ids) != n_rows:
        raise LareError(f"env_ids has {len(ids)} entries, but there are {n_rows} steps")
    # Copies, because an environment may write its next step into the same memory.
    observation, action, next_observation = (array[rows] for array in arrays)
    new = NewSteps(
        rows=rows,
        n_rows=n_rows,
        env_ids=[ids[row] for row in rows.tolist()],
        steps=(observation, action, next_observation),
        reward=team_reward[rows],
        ended=ended[rows],
        alive=None if alive is None else alive[rows],
    )
    _check_finite(rows, new.steps, new.reward)
    return new


def read_episode(
    config: AssignerConfig, steps: tuple[Any, Any, Any], reward: Any, alive: Any
) -> tuple[NewSteps, PaymentRule]:
    """Return the arguments of `CreditAssigner.add_episode`, and when the episode was paid. Raises `LareError` if they do not fit."""
    arrays = to_rows(config, *steps)
    n_steps = len(arrays[0])
    if not n_steps:
        raise LareError("the episode has no step")
    is_score, is_last = np.ndim(reward) == 0, np.arange(n_steps) == n_steps - 1
    rewards = np.zeros(n_steps) if is_score else reward
    new = read_steps(config, arrays, rewards, is_last, np.zeros(n_steps, bool), None, None, alive)
    score = float(reward) if is_score else float(new.reward.sum())
    if not np.isfinite(score):
        raise LareError(f"the score is {score}: give a finite number")
    if is_score:
        new.reward[-1] = score
    return new, config.payments.for_scores if is_score else config.payments


def to_rows(
    config: AssignerConfig, observation: Any, action: Any, next_observation: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return steps as rows of numbers. Raises `LareError` if their shapes do not fit together."""
    rows = {
        "observation": config.observation.rows(observation, "observation"),
        "action": config.action.rows(action, "action"),
        "next_observation": config.observation.rows(next_observation, "next_observation"),
    }
    n_steps = len(rows["observation"]) if rows["observation"].ndim > 1 else 0
    for name, values in rows.items():
        if values.shape[:-1] != (n_steps, *config.agent_axis):
            shape = ", ".join(["steps", *map(str, config.agent_axis), str(values.shape[-1])])
            raise LareError(f"{name} has the shape {values.shape}: give it rows ({shape}), as many as the observations")
    return rows["observation"], rows["action"], rows["next_observation"]


def to_levels(
    config: AssignerConfig, group: Sequence[Hashable] | None, new: NewSteps, group_names: dict[GroupName, int]
) -> Int[np.ndarray, " steps"]:
    """Return the number of the group of each new step, and add new groups to `group_names`. It is -1 for None.

    Raises `LareError` if there are too many groups, if they do not fit, or if a step that is paid has none. `group_names` is then
    unchanged.
    """
    if (group is not None) != config.groups:
        needs, has_none = (
            "needs group: give group=, one for each row; or set groups=False, if your adapter has none",
            "has no groups: leave group out, or set groups=True",
        )
        raise LareError(f"this assigner {needs if config.groups else has_none}")
    if group is None:
        return np.zeros(len(new.rows), np.int32)
    if isinstance(group, str):
        raise LareError(f"group is one text, {short_repr(group)}: give a list with the group of each row")
    if len(group) != new.n_rows:
        raise LareError(f"group has {len(group)} entries, but there are {new.n_rows} steps")
    names = [_to_group_name(group[row]) for row in new.rows.tolist()]
    numbers = dict(group_names)
    for name in names:
        if name is not None:
            numbers.setdefault(name, len(numbers))
    if len(numbers) > MAX_LEVELS:
        raise LareError(f"there are more than {MAX_LEVELS} groups, such as {list(numbers)[-1]!r}: merge some of them")
    level = np.array([-1 if name is None else numbers[name] for name in names], np.int32)
    if np.any((level < 0) & (new.ended | (not config.payments.only_at_end))):
        raise LareError("the group of an episode is None when it is paid: give the group of each row that is paid")
    group_names |= numbers
    return level


def _to_group_name(value: Any) -> GroupName | None:
    """Return a group as a text or a number of Python, which stay the same in a file. Raises `LareError` for anything else."""
    name = value.item() if isinstance(value, np.generic | np.ndarray) and value.size == 1 else value
    if name is not None and (not isinstance(name, str | int | float) or name != name):  # NaN
        raise LareError(f"a group is a text or a number, and not {short_repr(value)}")
    return name


def _to_team_reward(
    config: AssignerConfig, reward: Any, alive: Any, n_steps: int
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, "n agents"] | None]:
    """Return the team's reward of each step, and which agents were alive, if that is given."""
    reward = np.asarray(reward, np.float64)
    mask = None if alive is None else np.asarray(alive, bool)
    if mask is not None and (mask.shape != (n_steps, config.agents) or config.agents == 1):
        raise LareError(f"alive has the shape {mask.shape}: give it ({n_steps}, agents), of more than one agent")
    if config.agents > 1 and reward.shape == (n_steps, config.agents):
        return alive_mean(reward, np.ones(reward.shape, bool) if mask is None else mask), mask
    return _check_shape(reward, "reward", "number", n_steps), mask


def _check_shape(values: np.ndarray, name: str, noun: str, n_rows: int) -> np.ndarray:
    if values.shape != (n_rows,):
        raise LareError(f"{name} has the shape {values.shape}: give one {noun} for each of {n_rows} steps")
    return values


def to_flags(values: Any, name: str, n_rows: int) -> Bool[np.ndarray, " steps"]:
    """Return one flag for each row. Raises `LareError` if there are more or fewer."""
    return _check_shape(np.asarray(values, bool), name, "flag", n_rows)


def to_lengths(values: Any, n_rows: int) -> Int[np.ndarray, " steps"]:
    """Return the length of each row's episode. Raises `LareError` if there are more or fewer, or for one that is no length."""
    lengths = _check_shape(np.asarray(values, np.float64), "length", "number", n_rows)
    wrong = np.flatnonzero(~((lengths >= 1) & (lengths < 2**31)) | (lengths != np.floor(lengths)))
    if len(wrong):
        raise LareError(f"length of row {wrong[0]} is {lengths[wrong[0]]:g}: give the number of steps of its episode")
    return lengths.astype(np.int32)


def to_step_ids(steps: Any) -> Int[np.ndarray, "*shape"]:
    """Return numbers of steps as an array. Raises `LareError` for anything else."""
    try:
        step_ids = np.asarray(steps)
    except ValueError:  # lists of different lengths
        step_ids = np.array("")
    if step_ids.size and (step_ids.dtype.kind not in "iu" or step_ids.min() < -1):
        raise LareError(f"steps are {short_repr(steps)}: give numbers that `add` has returned, or -1")
    return step_ids.astype(np.int64)


def _check_finite(rows: np.ndarray, steps: Sequence[np.ndarray], reward: np.ndarray) -> None:
    """Raise `LareError` for the first number that is not finite. `rows` are the indices of the rows in the user's arrays."""
    names = ("observation", "action", "next_observation", "reward")
    for name, values in zip(names, (*steps, reward), strict=True):
        if not np.isfinite(values).all():
            index = np.argwhere(~np.isfinite(values))[0]
            entry = f" in entry {', '.join(map(str, index[1:]))}" if len(index) > 1 else ""
            raise LareError(f"{name} of row {rows[index[0]]} has {values[tuple(index)]}{entry}: give finite numbers")
