"""How strongly observations and factors correlate with the true reward.

    python benchmarks/correlation.py RUN [RUN ...]

Absolute correlation (Pearson's) of each entry with the agent's true reward of the same step, mean over the entries that vary:
40 episodes of random actions, and of the run's own policy (first seed). The runs must have latent functions.
"""

import sys

import numpy as np

from lare_rl.evaluation.episode_credit import correlations
from lare_rl.evaluation.team_matches import sample
from lare_rl.runs.directory import open_run
from measure import write


def main(directories: list[str]) -> None:
    found = {}
    for directory in directories:
        run = open_run(directory)
        for random in (True, False):
            for role, taken in zip(run.config.task.roles, sample(run, random=random), strict=True):
                of_each = {
                    "observation": correlations(taken.observation, taken.reward),
                    "factors": taken.correlations,
                }
                figures = {name: round(float(np.nanmean(np.abs(values))), 3) for name, values in of_each.items()}
                figures["best factor"] = round(float(np.nanmax(np.abs(of_each["factors"]))), 3)
                policy = "random" if random else f"{run.config.settings.method}, trained"
                settings = run.config.settings
                found[f"{role.name}, {policy}, draw {settings.draw}"] = figures | {"steps": settings.steps}
                print(f"{role.name:28s} {policy:20s} {figures}")
    write("correlation", {"absolute correlation with the true reward": found})


if __name__ == "__main__":
    main(sys.argv[1:])
