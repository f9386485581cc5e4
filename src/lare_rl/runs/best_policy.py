"""The policy of each seed's best evaluation, kept beside the last checkpoint.

    checkpoint/best.npz     the arrays that are needed to act; score and step of each seed

The best of many evaluations overestimates its policy. So `lare-rl evaluate --best` plays it from initial states that none of them
has used.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from lare_rl.errors import LareError
from lare_rl.runs.checkpoint import DAMAGED, fill, named_leaves, opened
from lare_rl.util.files import write_atomically

FILE = "best.npz"


class Best(NamedTuple):
    """The best evaluation of each seed."""

    score: Float[np.ndarray, " seeds"]
    """The mean return of its best evaluation; -inf before the first."""
    step: Int[np.ndarray, " seeds"]
    """The environment step of that evaluation."""
    actor: Any
    """The arrays that are needed to act as in that evaluation. None before the first one."""


def none_yet(seeds: int) -> Best:
    """The state before the first evaluation."""
    return Best(np.full(seeds, -np.inf), np.zeros(seeds, np.int64), None)


def better_of(best: Best, score: Float[np.ndarray, " seeds"], step: int, actor: Any) -> Best:
    """For each seed, the newest policy if its evaluation is better than all earlier ones, else the old one. NaN is never better."""
    better = np.asarray(score) > best.score
    if best.actor is None:
        kept = jax.tree.map(np.asarray, actor)
    else:

        def chosen(old: Any, new: Any) -> np.ndarray:
            return np.where(better.reshape(-1, *[1] * (old.ndim - 1)), np.asarray(new), np.asarray(old))

        kept = jax.tree.map(chosen, best.actor, actor)
    return Best(np.where(better, score, best.score), np.where(better, step, best.step), kept)


def save(directory: Path, best: Best) -> None:
    """Write it into a checkpoint's directory. Raises `LareError` if it cannot be written."""
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(best).items()}
    directory.mkdir(exist_ok=True)
    write_atomically(directory / FILE, lambda file: np.savez(file, allow_pickle=False, **arrays))


def load(directory: Path, shapes: Any, seeds: Sequence[int]) -> Best:
    """Read it from a checkpoint's directory.

    Args:
        directory: the directory of the checkpoint.
        shapes: an actor, whose leaves may be only shapes.
        seeds: the seeds of the run.

    Raises:
        LareError: there is no such file, or it has another structure.
    """
    path = directory / FILE
    if not path.is_file():
        raise LareError(
            f"there is no {path}: the run has not been evaluated yet, trains several teams, or is of an older version"
        )
    try:
        with opened(path) as saved:
            return fill(none_yet(len(seeds))._replace(actor=shapes), saved)
    except DAMAGED as error:
        raise LareError(f"{path} cannot be read: {error or type(error).__name__}") from error
