"""How closed-form credit depends on `phi`: five draws, one factor left out, an irrelevant function, no function.

    python benchmarks/functions.py RUN

RUN is a finished run on the body of HalfCheetah-v4 that still has its replay. As in `basis.py`, its stored episodes get new scores.
Each function computes its factors of all steps. The decoder of `lare-bayes`, and one that sees the factors alone, are fitted to
the returns of the first N episodes of a seed, and predict the rewards of the steps of the next five.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import lare_rl
from basis import ASKED, CHOSEN, fitted, scores, standardised
from lare_rl.credit.basis import pairs
from lare_rl.runs.directory import read_config
from measure import write
from missing_factors import FACTORS, source
from stored import of_each_seed

TASK, SPEED = "HalfCheetah-v4", 8
EPISODES = (15, 30, 55)
ASKED_OF = ("target speed", "no more than 3 m/s", "an entry no factor sees")


def functions() -> Iterator[tuple[str, lare_rl.LatentFunction]]:
    task = lare_rl.load_task(TASK)
    for draw in range(5):
        yield f"draw {draw}", lare_rl.design(task, draw=draw)
    with TemporaryDirectory() as place:
        for name in (*(f"without-{factor}" for factor in FACTORS[TASK]), "irrelevant"):
            path = Path(place) / f"{name}.py"
            path.write_text(source(TASK, name))
            yield name, lare_rl.load_function(path, task)


def groups_of(z: Array | None, x: Array) -> Iterator[tuple[str, list[Array]]]:
    if z is None:
        yield "all", [x, CHOSEN(x)]
        return
    yield "factors alone", [z]
    yield "all", [z, CHOSEN(z), pairs(z), x, CHOSEN(x)] if z.shape[1] > 1 else [z, CHOSEN(z), x, CHOSEN(x)]


def main(directory: str) -> None:
    chosen: dict[str, lare_rl.LatentFunction | None] = {**dict(functions()), "none": None}
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for after, action, _, paid, ends in of_each_seed(directory):
        truths = scores(after, action, paid, SPEED)
        x = np.concatenate([after, action], axis=1)
        for name, function in chosen.items():
            z = None if function is None else np.asarray(function(after, action))
            for count in (n for n in EPISODES if n + ASKED <= len(ends)):
                known, until = ends[count - 1], ends[count + ASKED - 1]
                begins, length = np.append(0, ends[: count - 1]), np.diff(np.append(0, ends[:count]))
                seen = None if z is None else standardised(z, known, until)
                for kind, groups in groups_of(seen, standardised(x, known, until)):
                    features = np.asarray(jnp.concatenate(groups, axis=1), np.float64)
                    group = tuple(np.repeat(np.arange(len(groups)), [part.shape[1] for part in groups]).tolist())
                    means = np.add.reduceat(features[:known], begins) / length[:, None]
                    for score in ASKED_OF:
                        reward = truths[score]
                        with jax.enable_x64(True):
                            weight, bias = fitted(means, np.add.reduceat(reward[:known], begins), length, group)
                        r_hat, true = features[known:until] @ np.asarray(weight) + float(bias), reward[known:until]
                        error = np.abs(r_hat - true).mean() / true.std()
                        found.setdefault((name, kind), []).append((np.corrcoef(r_hat, true)[0, 1], error))
    table = {}
    for (name, kind), each in found.items():
        correlation, error = np.array(each).T
        table[f"{name}, {kind}"] = {
            "correlation": round(float(np.nanmean(correlation)), 3),
            "median error": round(float(np.median(error)), 3),
            "fits": len(each),
        }
        print(f"{name + ', ' + kind:44s} {table[f'{name}, {kind}']}")
    write(
        "functions",
        {"task": read_config(Path(directory)).task.name, "episodes": EPISODES, "asked": ASKED, "functions": table},
    )


if __name__ == "__main__":
    main(sys.argv[1])
