"""How closed-form credit depends on `phi`: five draws, one factor left out, an irrelevant function, no function.

    python benchmarks/functions.py RUN

RUN is a finished run on the body of HalfCheetah-v4 that still has its replay. As in `basis.py`, its stored episodes get new scores.
Each function computes its factors of all steps. The decoder of `lare-bayes`, and one that sees the factors alone, are fitted to
the returns of the first N episodes of a seed, and predict the rewards of the steps of the next five.
"""

import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jax import Array

import lare_rl
from basis import CHOSEN, TEST_EPISODES, predict_next_episodes, scores, standardised, summarise
from lare_rl.credit.basis import pair_products
from lare_rl.runs.config_file import read_config
from measure import write
from missing_factors import FACTORS, source
from stored import stored_episodes

TASK, SPEED = "HalfCheetah-v4", 8
EPISODES = (15, 30, 55)
ASKED_OF = ("target speed", "no more than 3 m/s", "an entry no factor sees")


def functions() -> Iterator[tuple[str, lare_rl.LatentFunction]]:
    task = lare_rl.load_task(TASK)
    for draw in range(5):
        yield f"draw {draw}", lare_rl.design(task, draw=draw)
    with TemporaryDirectory() as folder:
        for name in (*(f"without-{factor}" for factor in FACTORS[TASK]), "irrelevant"):
            path = Path(folder) / f"{name}.py"
            path.write_text(source(TASK, name))
            yield name, lare_rl.load_function(path, task)


def feature_groups(z: Array | None, x: Array) -> Iterator[tuple[str, list[Array]]]:
    if z is None:
        yield "all", [x, CHOSEN(x)]
        return
    yield "factors alone", [z]
    yield "all", [z, CHOSEN(z), pair_products(z), x, CHOSEN(x)] if z.shape[1] > 1 else [z, CHOSEN(z), x, CHOSEN(x)]


def main(directory: str) -> None:
    chosen: dict[str, lare_rl.LatentFunction | None] = {**dict(functions()), "none": None}
    fits = defaultdict(list)
    for after, action, _, true_reward, ends in stored_episodes(directory):
        truths = scores(after, action, true_reward, SPEED)
        x = np.concatenate([after, action], axis=1)
        for name, function in chosen.items():
            z = None if function is None else np.asarray(function(after, action))
            for count in (n for n in EPISODES if n + TEST_EPISODES <= len(ends)):
                n_train, end = ends[count - 1], ends[count + TEST_EPISODES - 1]
                factors = None if z is None else standardised(z, n_train, end)
                for kind, groups in feature_groups(factors, standardised(x, n_train, end)):
                    for score in ASKED_OF:
                        result = predict_next_episodes(groups, truths[score], ends, count)
                        if result is not None:
                            fits[f"{name}, {kind}"].append(result)
    figures = {"episodes": EPISODES, "asked": TEST_EPISODES, "functions": summarise(fits)}
    write("functions", {"task": read_config(Path(directory)).task.name, **figures})


if __name__ == "__main__":
    main(sys.argv[1])
