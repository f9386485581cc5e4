"""Whole episodes of a policy, and what an evaluation measures of them and of the policy's actions."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.config.train_config import TrainConfig
from lare_rl.data.replay import Replay, capacity
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import AnyArray, EnvSpec
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.policy import compile_policy
from lare_rl.training.rewards import team_metrics

__all__ = ["EpisodeBatch", "Evaluation", "greedy_actions", "metrics_lines", "saturation"]

N_STATES = 1000
"""The number of stored observations in which the saturation of a policy is measured."""
ACTION_BOUND = 0.99
"""A component of a normalised action is at a bound if its size is larger."""


class EpisodeBatch(NamedTuple):
    """Whole episodes, each from a different initial state."""

    steps: Trajectory
    """[time seeds episodes ...]."""
    mask: Bool[AnyArray, "time seeds episodes"]
    """Whether the episode had not ended before the step."""
    state: Any
    """The state of the environment after each step, [time seeds episodes ...]; None on the host."""


class Evaluation(NamedTuple):
    """Results of whole episodes of each seed's policy."""

    returns: Float[AnyArray, "seeds episodes teams"]
    """R of each team: the sum over time of the mean over its agents that are alive."""
    summed_returns: Float[AnyArray, "seeds episodes teams"]
    """The sum over time and over all agents of a team: the usual score of particle tasks."""
    lengths: Int[AnyArray, "seeds episodes"]
    """In steps."""
    measures: dict[str, Float[AnyArray, "seeds episodes"]]
    """The task's own measures and the group, from the last step."""

    def drop_group(self, task: TaskSpec) -> "Evaluation":
        """Return the evaluation without the measure of the group, whose mean says nothing, unless the task lists it as a measure."""
        names = [name for name in self.measures if name != task.group or name in task.measures]
        return self._replace(measures={name: self.measures[name] for name in names})

    def metrics(self, spec: EnvSpec) -> dict[str, Float[np.ndarray, " seeds"]]:
        """Return the means over the episodes, and the standard deviation of returns, by the keys of metrics.jsonl."""
        metrics = {"evaluation/length": self.lengths.mean(axis=1)}
        metrics |= {f"evaluation/{name}": values.mean(axis=1) for name, values in self.measures.items()}
        per_team = []
        for i in range(len(spec.teams)):
            returns, summed_returns = self.returns[..., i], self.summed_returns[..., i]
            per_team.append(
                {"evaluation/return": returns.mean(axis=1), "evaluation/return_std": returns.std(axis=1)}
                | ({"evaluation/summed_return": summed_returns.mean(axis=1)} if spec.n_agents > 1 else {})
            )
        return metrics | team_metrics(per_team, spec.teams)


def metrics_lines(seeds: Sequence[int], step: int, metrics: Mapping[str, Any], rate: float) -> list[dict[str, Any]]:
    """Return one line of metrics.jsonl for each seed, from arrays with one number for each seed."""
    lines = []
    for seed_index, seed in enumerate(seeds):
        numbers = {name: float(np.asarray(values)[seed_index]) for name, values in metrics.items()}
        # JSON has no NaN: a correlation with a value that never varies is null.
        valid = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        lines.append({"step": step, "seed": seed, **valid, "time/steps_per_second": float(f"{rate:.3g}")})
    return lines


def greedy_actions(actor: Any, replay: Replay, config: TrainConfig) -> Float[np.ndarray, "seeds states action"]:
    """Return an off-policy algorithm's actions without noise at the newest `N_STATES` observations of the first environment.

    If fewer are stored, they are repeated: the shape, and so the compiled program, is always the same.
    """
    rows = np.asarray(replay.next_row)[:, :1] - 1 - np.arange(N_STATES) % int(np.min(replay.next_row))
    observation = jax.vmap(lambda column, seed_rows: column[0, seed_rows])(
        replay.columns["observation"], rows % capacity(replay)
    )
    available = np.ones((*rows.shape, 1, config.env.action_size), bool)
    act = compile_policy(config, deterministic=True)
    return np.asarray(act(actor, (), observation, available, None, np.zeros(rows.shape, bool))[0])[:, :, 0]


def saturation(action: Float[np.ndarray, "seeds states action"]) -> Float[np.ndarray, " seeds"]:
    """Return the fraction of an action's components that are at the same bound in all states.

    The actions are without noise, and lie in [-1, 1].
    """
    bound = np.where(np.abs(action) > ACTION_BOUND, np.sign(action), 0)
    return np.mean((bound[:, 0] != 0) & np.all(bound == bound[:, :1], axis=1), axis=-1)
