"""A strength for each raw entry compared with one for each group, and the evidence that each additional strength must gain.

    python benchmarks/relevance.py RUN [RUN ...]

RUN is a finished run of HalfCheetah-v4 or Walker2d-v4 that still has its replay. Its stored episodes get the eight scores of
`basis.py`. Each fit sees the returns of the first N episodes of a seed, and predicts the rewards of the steps of the next five. The
results have the mean correlation with the true rewards of these steps, and the mean and the median error (in their standard
deviations): for groups, for strengths, and for the choice between both by the gain in evidence.
"""

import sys
from collections import defaultdict
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from basis import CHOSEN, SPEED, TEST_EPISODES, scores, standardised, summarise
from lare_rl.credit import evidence, relevance
from lare_rl.credit.basis import pair_products
from lare_rl.runs.config_file import read_config
from measure import write
from stored import stored_episodes

EPISODES = (8, 15, 25, 33)
ROUNDS = 20
GAINS = (0.1, 0.25, 0.5, 1.0)


@partial(jax.jit, static_argnames=("group", "strength"))
def fit(means, returns, length, group, strength):
    """Return weights, bias and log evidence of the fit by groups, and of the fit by strengths."""
    group_index, strength_index = np.array(group), np.array(strength)
    sums = evidence.add_episodes(evidence.empty_statistics(len(group)), means, returns, length)
    starts = [evidence.init_posterior(index) for index in (group_index, strength_index)]
    groups = evidence.fit(sums, 0, group_index, starts[0], 3 * ROUNDS)
    groups, separate = relevance.fit(sums, 0, group_index, strength_index, groups, starts[1], ROUNDS)
    return [(fit.weight, fit.bias, fit.log_evidence) for fit in (groups, separate)]


def compare(after, action, factors, rewards, ends, count):
    """Yield the correlation and the error of each fit to the first `count` episodes, for each score."""
    n_train, end = ends[count - 1], ends[count + TEST_EPISODES - 1]
    z, x = (standardised(rows, n_train, end) for rows in (factors, np.concatenate([after, action], axis=1)))
    groups = [z, CHOSEN(z), pair_products(z), x, CHOSEN(x)]
    features, n_raw = np.asarray(jnp.concatenate(groups, axis=1), np.float64), x.shape[1]
    sizes = [columns.shape[1] for columns in groups]
    group = np.repeat(np.arange(5), sizes)
    strength = np.concatenate([group[: sum(sizes[:3])], 3 + np.arange(n_raw), 3 + n_raw + np.arange(sizes[4]) % n_raw])
    begins, length = np.append(0, ends[: count - 1]), np.diff(np.append(0, ends[:count]))
    means = np.add.reduceat(features[:n_train], begins) / length[:, None]
    for reward in rewards.values():
        true = reward[n_train:end]
        if true.std() == 0 or reward[:n_train].std() == 0:
            continue
        returns = np.add.reduceat(reward[:n_train], begins)
        with jax.enable_x64(True):
            fits = fit(means, returns, length, tuple(group.tolist()), tuple(strength.tolist()))
        results = []
        for weight, bias, _ in fits:
            r_hat = features[n_train:] @ np.asarray(weight) + float(bias)
            correlation = np.corrcoef(r_hat, true)[0, 1] if r_hat.std() > 0 else 0.0
            results.append((correlation, np.abs(r_hat - true).mean() / true.std()))
        gain = float(fits[1][2] - fits[0][2]) / (strength.max() - group.max())
        yield {"groups": results[0], "strengths": results[1]} | {
            f"the better one, gain {least}": results[int(gain > least)] for least in GAINS
        }


def main(directories: list[str]) -> None:
    tables = {}
    for directory in directories:
        task = read_config(Path(directory)).task.name
        fits = defaultdict(list)
        for after, action, factors, reward, ends in stored_episodes(directory):
            rewards = scores(after, action, reward, SPEED[task])
            for count in (n for n in EPISODES if n + TEST_EPISODES <= len(ends)):
                for results in compare(after, action, factors, rewards, ends, count):
                    for name, result in results.items():
                        fits[f"{count:2d} episodes, {name}"].append(result)
        tables[task] = summarise(dict(sorted(fits.items())))
    write("relevance", {"episodes": EPISODES, "test_episodes": TEST_EPISODES, "tasks": tables})


if __name__ == "__main__":
    main(sys.argv[1:])
