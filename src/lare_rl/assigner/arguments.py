"""The arguments of a `CreditAssigner`: they are checked, and become rows of numbers."""

import contextlib
from collections.abc import Hashable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.assigner.assigner_config import AssignerConfig
from lare_rl.assigner.group_names import GroupName, to_group_name
from lare_rl.assigner.space_layout import check_numbers, to_array
from lare_rl.envs.interface import alive_mean
from lare_rl.errors import LareError, short_repr
from lare_rl.tasks.payments import PaymentRule
from lare_rl.tasks.spec import MAX_LEVELS

__all__ = [
    "NewSteps",
    "read_episode",
    "read_steps",
    "to_env_id",
    "to_flags",
    "to_lengths",
    "to_levels",
    "to_rows",
    "to_score",
    "to_step_ids",
]


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
    env_ids: Any,
    valid: Any,
    alive: Any,
) -> NewSteps:
    """Return the valid rows of the arguments of `CreditAssigner.add`. Raises `LareError` if they do not fit together.

    `arrays` are the steps as `to_rows` returns them.
    """
    n_rows = len(arrays[0])
    if alive is not None:
        if config.agents == 1:
            raise LareError("this assigner has a single agent: leave alive out")
        alive = to_flags(alive, "alive", n_rows, config.agents)
    team_reward = _to_team_reward(config, reward, alive, n_rows)
    ended = to_flags(terminated, "terminated", n_rows) | to_flags(truncated, "truncated", n_rows)
    rows = np.flatnonzero(np.ones(n_rows, bool) if valid is None else to_flags(valid, "valid", n_rows))
    if config.spec.is_exact and alive is not None and not alive[rows].any(axis=1).all():
        raise LareError(
            "with exact, an agent must act at every step of an episode, or part of its return is lost: use exact = 'no'"
        )
    ids = range(n_rows) if env_ids is None else list(map(to_env_id, _to_list(env_ids, "env_ids", n_rows)))
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
    names = ("observation", "action", "next_observation", "reward")
    for name, values in zip(names, (*new.steps, new.reward), strict=True):
        check_numbers(values, name, new.rows)
    return new


def read_episode(
    config: AssignerConfig, steps: tuple[Any, Any, Any], reward: Any, alive: Any
) -> tuple[NewSteps, PaymentRule]:
    """Return the steps of the arguments of `CreditAssigner.add_episode`, and the rule of their payments. Raises `LareError` like `add`."""
    arrays = to_rows(config, *steps)
    n_steps = len(arrays[0])
    if not n_steps:
        raise LareError("the episode has no step")
    reward = to_array(reward, "reward")
    is_score = reward.ndim == 0
    rewards = np.zeros(n_steps) if is_score else reward
    ended = np.arange(n_steps) == n_steps - 1
    new = read_steps(config, arrays, rewards, ended, np.zeros(n_steps, bool), None, None, alive)
    score = to_score(reward if is_score else new.reward.sum(), "the score")
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
            hint = "" if name == "observation" else ", with as many steps as observation"
            if name == "action" and config.action.kind == "choices":
                hint += "; give choices as whole numbers, or as one-hot rows of floats"
            raise LareError(f"{name} becomes rows of the shape {values.shape}: its axes must be ({shape}){hint}")
    return rows["observation"], rows["action"], rows["next_observation"]


def to_levels(
    config: AssignerConfig, group: Any, new: NewSteps, group_names: dict[GroupName, int]
) -> Int[np.ndarray, " steps"]:
    """Return the number of each new step's group, -1 for None, and add new groups to `group_names`.

    Raises `LareError` if there are too many groups, if they do not fit, or if a step that is paid has none; it then adds none.
    """
    if config.groups and group is None:
        raise LareError("this assigner needs groups: give group=, or set groups=False, if your adapter has none")
    if group is not None and not config.groups:
        raise LareError("this assigner has no groups: leave group out, or set groups=True")
    if group is None:
        return np.zeros(len(new.rows), np.int32)
    groups = _to_list(group, "group", new.n_rows)
    names = [None if groups[row] is None else to_group_name(groups[row]) for row in new.rows.tolist()]
    numbers = dict(group_names)
    for name in names:
        if name is not None:
            numbers.setdefault(name, len(numbers))
    if len(numbers) > MAX_LEVELS:
        raise LareError(f"there are more than {MAX_LEVELS} groups, such as {list(numbers)[-1]!r}: merge some of them")
    level = np.array([-1 if name is None else numbers[name] for name in names], np.int32)
    if np.any((level < 0) & (new.ended | config.payments.pays_early)):
        raise LareError("the group of an episode is None when it is paid: give the group of each row that is paid")
    group_names |= numbers
    return level


def _to_list(values: Any, name: str, n_rows: int) -> list[Any]:
    """Return a list with a value for each row. Raises `LareError` for more or fewer values, or if `values` is no list."""
    if isinstance(values, str) or not np.iterable(values):
        raise LareError(f"{name} is {short_repr(values)}: give a list, with an entry for each row")
    entries = list(values)
    if len(entries) != n_rows:
        raise LareError(f"{name} has {len(entries)} entries, but there are {n_rows} steps")
    return entries


def to_env_id(value: Any) -> Hashable:
    """Return an environment as a key of a dictionary. Raises `LareError` if it cannot be found again by its value."""
    env_id = value.tolist() if hasattr(value, "tolist") else value  # the hash of a tensor is its identity
    with contextlib.suppress(TypeError):
        hash(env_id)
        if env_id == env_id:  # false for NaN
            return env_id
    raise LareError(f"an env_id must be a text, a number or another hashable value, and is {short_repr(value)}")


def _to_team_reward(
    config: AssignerConfig, reward: Any, alive: Bool[np.ndarray, "rows agents"] | None, n_rows: int
) -> Float[np.ndarray, " rows"]:
    rewards = to_array(reward, "reward").astype(np.float64)
    if config.agents == 1:
        return _check_shape(rewards, "reward", "number", n_rows)
    if rewards.shape == (n_rows, config.agents):
        return alive_mean(rewards, np.ones(rewards.shape, bool) if alive is None else alive)
    return _check_shape(rewards, "reward", "number, or one for each agent,", n_rows)


def _check_shape(values: np.ndarray, name: str, noun: str, *shape: int) -> np.ndarray:
    if values.shape != shape:
        counts = " and ".join(f"{n} {axis}" for n, axis in zip(shape, ("steps", "agents"), strict=False))
        raise LareError(f"{name} has the shape {values.shape}: give one {noun} for each of {counts}")
    return values


def to_flags(values: Any, name: str, *shape: int) -> Bool[np.ndarray, "*shape"]:
    """Return flags, of a shape (steps,) or (steps, agents). Raises `LareError` if they do not fit, or are not true or false."""
    flags = _check_shape(to_array(values, name), name, "flag", *shape)
    if flags.dtype != bool and not np.isin(flags, (0, 1)).all():
        raise LareError(f"{name} must be true or false, and is {short_repr(values)}")
    return flags.astype(bool)


def to_lengths(values: Any, n_rows: int) -> Int[np.ndarray, " rows"]:
    """Return the length of each row's episode. Raises `LareError` for more or fewer, or if one is no positive whole number."""
    lengths = _check_shape(to_array(values, "length").astype(np.float64), "length", "number", n_rows)
    wrong = np.flatnonzero(~((lengths >= 1) & (lengths < 2**31)) | (lengths != np.floor(lengths)))
    if len(wrong):
        raise LareError(f"length of row {wrong[0]} is {lengths[wrong[0]]:g}: give the number of steps of its episode")
    return lengths.astype(np.int32)


def to_step_ids(steps: Any) -> Int[np.ndarray, "*shape"]:
    """Return numbers of steps as an array. Raises `LareError` for anything else."""
    step_ids = to_array(steps, "steps")
    if step_ids.size and (step_ids.dtype.kind not in "iu" or step_ids.astype(np.int64).min() < -1):
        raise LareError(f"steps are {short_repr(steps)}: give numbers that `add` has returned, or -1")
    return step_ids.astype(np.int64)


def to_score(score: Any, name: str) -> float:
    """Return a score as a number. Raises `LareError` if it is not a single number, not finite, or too large."""
    number = to_array(score, name)
    if number.size != 1:
        raise LareError(f"{name} is {short_repr(number.tolist())}: give a single number")
    check_numbers(number.reshape(()), name)
    return float(number.item())
