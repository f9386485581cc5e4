"""How strongly observations and factors correlate with the true reward.

    python benchmarks/correlation.py RUN [RUN ...]

Absolute correlation (Pearson's) of each entry with the agent's true reward of the same step, mean over the entries that vary:
40 episodes of random actions, and of the run's own policy (first seed). The runs must be IPPO's, and have latent functions.
"""

import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.evaluation.played_episodes import sample_steps
from lare_rl.runs.directory import Run, open_run
from lare_rl.training.saved_state import load_actor
from lare_rl.util.statistics import column_correlations
from measure import write


def make_indifferent_actor(run: Run) -> Any:
    """Return an actor whose networks are 0, so that IPPO samples all actions equally often."""
    _, actors, _ = load_actor(run)
    return jax.tree.map(lambda leaf: jnp.zeros_like(leaf[:1]), actors)


def main(directories: list[str]) -> None:
    results = {}
    for directory in directories:
        run = open_run(directory)
        for random in (True, False):
            actor = make_indifferent_actor(run) if random else None
            for role, sample in zip(run.config.task.roles, sample_steps(run, actor), strict=True):
                correlations = {
                    "observation": column_correlations(sample.next_observation, sample.reward),
                    "factors": sample.correlations,
                }
                figures = {name: round(float(np.nanmean(np.abs(values))), 3) for name, values in correlations.items()}
                figures["best factor"] = round(float(np.nanmax(np.abs(correlations["factors"]))), 3)
                policy = "random" if random else f"{run.config.settings.method}, trained"
                settings = run.config.settings
                results[f"{role.name}, {policy}, draw {settings.draw}"] = figures | {"steps": settings.steps}
                print(f"{role.name:28s} {policy:20s} {figures}")
    write("correlation", {"absolute correlation with the true reward": results})


if __name__ == "__main__":
    main(sys.argv[1:])
