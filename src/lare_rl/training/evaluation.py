"""Whole episodes of a policy, and what an evaluation measures of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import AnyArray, EnvSpec

__all__ = ["EpisodeBatch", "Evaluation", "concatenate"]


class EpisodeBatch(NamedTuple):
    """Whole episodes, each from a different initial state."""

    steps: Trajectory
    """[time seeds episodes ...]."""
    mask: Bool[AnyArray, "time seeds episodes"]
    """Whether the episode had not ended before the step."""
    state: Any
    """The states after each step of an environment of pure functions, [time seeds episodes ...]; None on the host."""


@dataclass(frozen=True)
class Evaluation:
    """Results of whole episodes of each seed's policy."""

    returns: Float[np.ndarray, "seeds episodes teams"]
    """R of each team: the sum over time of the mean over its agents that are alive."""
    summed_returns: Float[np.ndarray, "seeds episodes teams"]
    """The sum over time and over all agents of a team: the usual score of particle tasks."""
    lengths: Int[np.ndarray, "seeds episodes"]
    """In steps."""
    measures: dict[str, Float[np.ndarray, "seeds episodes"]]
    """The task's own measures, from the last step."""

    def metrics(self, spec: EnvSpec) -> dict[str, Float[np.ndarray, " seeds"]]:
        """Return the means over the episodes, and the standard deviation of returns, by the keys of metrics.jsonl.

        With several teams, each has its own keys, and the keys without a suffix are those of the first team.
        """
        metrics = {"evaluation/length": self.lengths.mean(axis=1)}
        metrics |= {f"evaluation/{name}": values.mean(axis=1) for name, values in self.measures.items()}
        suffixes = [("", 0)]
        if len(spec.teams) > 1:
            suffixes += [(f"_{team.name}", team_index) for team_index, team in enumerate(spec.teams)]
        for suffix, team_index in suffixes:
            metrics[f"evaluation/return{suffix}"] = self.returns[..., team_index].mean(axis=1)
            metrics[f"evaluation/return_std{suffix}"] = self.returns[..., team_index].std(axis=1)
            if spec.n_agents > 1:
                metrics[f"evaluation/summed_return{suffix}"] = self.summed_returns[..., team_index].mean(axis=1)
        return metrics


def concatenate(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Concatenate the episodes of evaluations of the same seeds."""
    first = evaluations[0]
    return Evaluation(
        returns=np.concatenate([evaluation.returns for evaluation in evaluations], axis=1),
        summed_returns=np.concatenate([evaluation.summed_returns for evaluation in evaluations], axis=1),
        lengths=np.concatenate([evaluation.lengths for evaluation in evaluations], axis=1),
        measures={
            name: np.concatenate([evaluation.measures[name] for evaluation in evaluations], axis=1)
            for name in first.measures
        },
    )
