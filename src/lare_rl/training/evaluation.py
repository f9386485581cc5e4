"""The results of evaluation episodes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lare_rl.envs.interface import EnvSpec


@dataclass(frozen=True)
class Evaluation:
    """Results of whole episodes of each seed's policy."""

    returns: Float[np.ndarray, "seeds episodes teams"]
    """R of each team: the sum over time of the mean over its agents that are alive."""
    sums: Float[np.ndarray, "seeds episodes teams"]
    """The sum over time and over all agents of a team, which is the usual score of particle tasks."""
    lengths: Int[np.ndarray, "seeds episodes"]
    """Lengths in steps."""
    measures: dict[str, Float[np.ndarray, "seeds episodes"]]
    """The task's own measures, taken from the last step."""

    def metrics(self, spec: EnvSpec) -> dict[str, Float[np.ndarray, " seeds"]]:
        """Means over the episodes, and the deviation of returns, by the keys of metrics.jsonl. Several teams have separate keys."""
        found = {"evaluation/length": self.lengths.mean(axis=1)}
        found |= {f"evaluation/{name}": values.mean(axis=1) for name, values in self.measures.items()}
        for place, team in enumerate(spec.teams):
            for suffix in ("", f"_{team.name}") if place == 0 else (f"_{team.name}",):
                if suffix and len(spec.teams) == 1:
                    continue
                found[f"evaluation/return{suffix}"] = self.returns[..., place].mean(axis=1)
                found[f"evaluation/return_std{suffix}"] = self.returns[..., place].std(axis=1)
                if spec.agents > 1:
                    found[f"evaluation/summed_return{suffix}"] = self.sums[..., place].mean(axis=1)
        return found


def together(parts: Sequence[Evaluation]) -> Evaluation:
    """Merge evaluations of the same seeds."""

    def joined(arrays: Iterable[np.ndarray]) -> np.ndarray:
        return np.concatenate(list(arrays), axis=1)

    measures = {name: joined(part.measures[name] for part in parts) for name in parts[0].measures}
    returns, sums, lengths = (joined(getattr(part, name) for part in parts) for name in ("returns", "sums", "lengths"))
    return Evaluation(returns, sums, lengths, measures)
