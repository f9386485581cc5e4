"""Which features a closed-form decoder should have: the quality of its credit, by features, for scores that no task text describes.

    python benchmarks/basis.py RUN

RUN is a finished run of HalfCheetah-v4 or Walker2d-v4 that still has its replay. Its stored episodes get new scores, in eight
ways. Each basis is fitted in closed form to the returns of the first N episodes of a seed, and predicts the rewards of the steps of
the next five. The results have, for every basis: the mean over scores, N and seeds of the correlation with the true rewards of
those steps and of the mean error (in their standard deviations), and the median error.
"""

import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lare_rl.credit import evidence
from lare_rl.credit.basis import pair_products
from lare_rl.runs.config_file import read_config
from measure import write
from stored import stored_episodes

EPISODES = (8, 15, 25, 40, 60)
TEST_EPISODES = 5
ROUNDS = 60
SPEED = {"HalfCheetah-v4": 8, "Walker2d-v4": 8}
"""The entry of the observation that is the speed; 1 is the pitch of the body in both."""


def scores(after: np.ndarray, action: np.ndarray, reward: np.ndarray, speed: int) -> dict[str, np.ndarray]:
    """Rewards of steps that add up to eight scores."""
    v, effort = after[:, speed], (action**2).sum(axis=1)
    return {
        "the task's own": reward,
        "target speed": np.exp(-((v - 2) ** 2)) - 0.02 * effort,
        "saturating": np.tanh(v) - 0.05 * effort + 0.5 * np.cos(after[:, 1]),
        "no more than 3 m/s": np.minimum(v, 3) - 0.1 * effort,
        "threshold": (v > 2).astype(float),
        "an entry no factor sees": v - 0.1 * effort + after[:, 7],
        "its square": v - 0.1 * effort - 2 * after[:, 3] ** 2,
        "product": v * np.cos(after[:, 1]) - 0.1 * effort,
    }


Shape = Callable[[Float[Array, "rows inputs"]], Float[Array, "rows features"]]


def fourier(u: Array, frequencies: int) -> Array:
    within = jnp.clip(u, -4, 4)
    angles = [(k, k * jnp.pi * within / 4) for k in range(1, frequencies + 1)]
    return jnp.concatenate([wave(angle) / k for k, angle in angles for wave in (jnp.cos, jnp.sin)], axis=1)


def random_fourier(u: Array, count: int, width: float) -> Array:
    draw = np.random.default_rng(0)
    waves = [(draw.normal() * width, draw.uniform(0, 2 * np.pi)) for _ in range(count)]
    return jnp.concatenate([jnp.cos(w * jnp.clip(u, -5, 5) + b) for w, b in waves], axis=1)


def bumps(u: Array, count: int) -> Array:
    centres = np.linspace(-2, 2, count)
    return jnp.concatenate([jnp.exp(-0.5 * ((jnp.clip(u, -5, 5) - c) * (count - 1) / 4) ** 2) for c in centres], axis=1)


def hinges(u: Array, count: int) -> Array:
    return jnp.concatenate([jnp.maximum(jnp.clip(u, -5, 5) - c, 0) for c in np.linspace(-1.5, 1.5, count)], axis=1)


def powers(u: Array, highest: int) -> Array:
    return jnp.concatenate([jnp.clip(u, -3, 3) ** k for k in range(2, highest + 1)], axis=1)


SHAPES: dict[str, Shape] = {
    "6 random Fourier features": partial(random_fourier, count=6, width=1.0),
    "10 random Fourier features": partial(random_fourier, count=10, width=1.0),
    "6 random Fourier features, twice as fast": partial(random_fourier, count=6, width=2.0),
    "Fourier series, 2 frequencies": partial(fourier, frequencies=2),
    "Fourier series, 3 frequencies": partial(fourier, frequencies=3),
    "Fourier series, 5 frequencies": partial(fourier, frequencies=5),
    "powers to 4": partial(powers, highest=4),
    "6 bumps": partial(bumps, count=6),
    "6 hinges": partial(hinges, count=6),
}


CHOSEN = SHAPES["Fourier series, 3 frequencies"]


def bases(z: Array, x: Array) -> Iterator[tuple[str, list[Array]]]:
    """Each basis by its name: the groups of features of standardised factors and entries."""
    yield "factors", [z]
    yield "factors, shapes", [z, CHOSEN(z)]
    yield "factors, shapes, pairs", [z, CHOSEN(z), pair_products(z)]
    yield "factors, entries", [z, x]
    yield "entries", [x]
    yield "entries, shapes", [x, CHOSEN(x)]
    yield "factors, pairs, entries", [z, pair_products(z), x]
    yield "factors, entries, shapes of both; 3 frequencies, no pairs", [z, CHOSEN(z), x, CHOSEN(x)]
    yield "entries, shapes, pairs", [x, CHOSEN(x), pair_products(x)]
    yield "all: pairs of entries too", [z, CHOSEN(z), pair_products(z), x, CHOSEN(x), pair_products(x)]
    for name, shape in SHAPES.items():
        yield f"all: {name}", [z, shape(z), pair_products(z), x, shape(x)]


@partial(jax.jit, static_argnames="group")
def fitted(means: Array, returns: Array, length: Array, group: tuple[int, ...]) -> tuple[Array, Array]:
    numbers = np.array(group)
    sums = evidence.add_episodes(evidence.empty_statistics(len(numbers)), means, returns, length)
    n_train = evidence.init_posterior(numbers)
    errors = evidence.fit(sums, 0, numbers, n_train, ROUNDS)
    return errors.weight, errors.bias


def standardised(rows: np.ndarray, n_train: int, end: int) -> Array:
    """Rows, standardised by the known steps."""
    deviation = rows[:n_train].std(axis=0)
    return jnp.asarray((rows[:end] - rows[:n_train].mean(axis=0)) / np.where(deviation > 0, deviation, 1))


Groups = Sequence[Array]
"""The groups of features of a basis; each has one row for every step."""


def predict_next_episodes(
    groups: Groups, reward: np.ndarray, ends: np.ndarray, count: int
) -> tuple[float, float] | None:
    """Fit the first `count` episodes, and return correlation and error on the next ones; None if their rewards are constant."""
    n_train = ends[count - 1]
    true = reward[n_train : ends[count + TEST_EPISODES - 1]]
    if true.std() == 0 or reward[:n_train].std() == 0:
        return None
    features = np.asarray(jnp.concatenate(groups, axis=1), np.float64)
    group = tuple(np.repeat(np.arange(len(groups)), [columns.shape[1] for columns in groups]).tolist())
    begins, length = np.append(0, ends[: count - 1]), np.diff(np.append(0, ends[:count]))
    means = np.add.reduceat(features[:n_train], begins) / length[:, None]
    with jax.enable_x64(True):
        weight, bias = fitted(means, np.add.reduceat(reward[:n_train], begins), length, group)
    r_hat = features[n_train:] @ np.asarray(weight) + float(bias)
    return float(np.corrcoef(r_hat, true)[0, 1]), float(np.abs(r_hat - true).mean() / true.std())


def summarise(fits: Mapping[str, Sequence[tuple[float, float]]]) -> dict[str, dict[str, float]]:
    """Means and medians over the fits of each basis, which are printed too."""
    table = {}
    for name, values in fits.items():
        correlation, error = np.array(values).T
        table[name] = {
            "correlation": round(float(np.nanmean(correlation)), 3),
            "error": round(float(error.mean()), 3),
            "median error": round(float(np.median(error)), 3),
            "fits": len(values),
        }
        print(f"{name:62s} {table[name]}")
    return table


def main(directory: str) -> None:
    task = read_config(Path(directory)).task.name
    fits = defaultdict(list)
    for after, action, z, reward_paid, ends in stored_episodes(directory):
        truths = scores(after, action, reward_paid, SPEED[task])
        for count in (n for n in EPISODES if n + TEST_EPISODES <= len(ends)):
            n_train, end = ends[count - 1], ends[count + TEST_EPISODES - 1]
            standard = [standardised(rows, n_train, end) for rows in (z, np.concatenate([after, action], axis=1))]
            for name, groups in bases(*standard):
                results = (predict_next_episodes(groups, reward, ends, count) for reward in truths.values())
                fits[name] += [result for result in results if result is not None]
    write("basis", {"task": task, "episodes": EPISODES, "asked": TEST_EPISODES, "bases": summarise(fits)})


if __name__ == "__main__":
    main(sys.argv[1])
