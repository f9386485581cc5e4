"""Advice about a training that may not get anywhere, in sentences."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from lare_rl.algorithms.settings import PPOSettings
from lare_rl.credit.explanation_text import entry_names
from lare_rl.data.replay import Replay
from lare_rl.runs.directory import Run
from lare_rl.training.static_config import TrainConfig

LARGE = 10.0
"""The largest root mean square of an entry of the observation that needs no remark."""
ROWS = 1000
"""So many stored observations of an environment are looked at."""
SATURATION = "actor/saturation"
"""The metric: see `saturation`."""
BOUND = 0.99
"""An entry of an action is at a bound if it is larger than this part of it."""
SAME = 5
"""So many evaluations with equal returns are reported."""
EQUAL = 1e-3
"""Returns are equal if they differ by less than this part of their size."""


def of_observations(run: Run, held: Replay, config: TrainConfig) -> list[str]:
    """A remark if an entry of the observations is large and the algorithm does not normalise observations; else nothing.

    A large entry may drive a policy that ends in a tanh to a bound of the actions before its first update. Its gradient is then 0.
    """
    algorithm, hyperparameters = run.config.settings.algorithm, run.config.settings.hyperparameters
    can_normalise = isinstance(hyperparameters, PPOSettings)
    if (can_normalise and hyperparameters.normalise_observations) or "observation" not in held.columns:
        return []
    rows = min(ROWS, int(np.min(np.asarray(held.next_row)[0])))
    seen = np.asarray(held.columns["observation"][0, :, :rows]).reshape(-1, config.env.observation_size)
    sizes = np.sqrt(np.mean(np.square(seen), axis=0))
    largest = int(np.argmax(sizes))
    if not sizes[largest] > LARGE:
        return []
    role = run.config.task.roles[0]
    name = entry_names(role.observation, "", config.env.observation_size, 0, both=False)[largest]
    other = f", or set --{algorithm}.normalise-observations True" if can_normalise else ""
    if config.algorithm.one_agent and config.env.agents == 1:
        other = ", or use --algorithm ppo, which normalises observations"
    return [
        f"Observations are large: the root mean square of {name} is {sizes[largest]:.3g} in the first steps, and {algorithm} does "
        "not normalise observations. Its actions may stay at their bounds. Let the environment divide each entry by its range, so "
        f"that it is within about -1 and 1{other}."
    ]


def saturation(actions: Float[np.ndarray, "seeds steps action"]) -> Float[np.ndarray, " seeds"]:
    """The share of an action's entries that are at the same bound in all states.

    Args:
        actions: those of each seed's policy, without noise, in some states; between -1 and 1.
    """
    bound = np.where(np.abs(actions) > BOUND, np.sign(actions), 0)
    return np.mean((bound[:, 0] != 0) & np.all(bound == bound[:, :1], axis=1), axis=-1)


def of_saturation(shares: Sequence[float], seeds: Sequence[int]) -> list[str]:
    """A remark if a policy chooses the same bounds in all states; else nothing.

    Args:
        shares: the saturation of each seed's policy.
        seeds: the numbers of the seeds.
    """
    stuck = [str(seed) for seed, share in zip(seeds, shares, strict=True) if share == 1]
    if not stuck:
        return []
    whose = (
        "The policy"
        if len(seeds) == 1
        else f"The policy of {'seed' if len(stuck) == 1 else 'seeds'} {', '.join(stuck)}"
    )
    return [
        f"{whose} chooses the same action in every state, with each entry at a bound. If the task needs more than that, the policy "
        "is stuck, and more steps seldom help: see docs/bring-your-own-task.md, section 4."
    ]


def of_returns(returns: Sequence[Float[np.ndarray, " seeds"]]) -> list[str]:
    """A remark when the last evaluations of every seed have the same return, and did not have it before; else nothing.

    Args:
        returns: those of the evaluations since the policy was first updated.
    """
    if not are_equal(returns[-SAME:]) or are_equal(returns[-SAME - 1 : -1]):
        return []
    return [
        f"The last {SAME} evaluations of every seed have the same return: the policy does not change what it does. If this return "
        "is not a good one, the policy is stuck: see docs/bring-your-own-task.md, section 4."
    ]


def are_equal(returns: Sequence[Float[np.ndarray, " seeds"]]) -> bool:
    """Whether there are enough evaluations, and the returns of each seed differ by nothing or hardly anything."""
    if len(returns) < SAME:
        return False
    each = np.array(returns)
    return bool(np.all(np.ptp(each, axis=0) <= EQUAL * np.abs(each).max(axis=0)))
