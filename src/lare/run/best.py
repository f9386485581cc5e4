"""The policy of each seed's best evaluation, kept beside the last checkpoint.

    checkpoint/best.npz     the arrays that are needed to act; score and step of each seed

The best of many evaluations looks better than it is: `lare evaluate --best` plays it from starts that none of them has used.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from lare.errors import LareError
from lare.files import write_atomically
from lare.run.checkpoint import DAMAGED, fill, named_leaves, opened

FILE = "best.npz"


class Best(NamedTuple):
    """Of each seed."""

    score: Float[np.ndarray, " seeds"]
    """The mean return of its best evaluation; -inf before the first."""
    step: Int[np.ndarray, " seeds"]
    """The environment step of that evaluation."""
    actor: Any
    """The arrays that are needed to act as it did. None before the first evaluation."""


def none_yet(seeds: int) -> Best:
    """Before the first evaluation."""
    return Best(np.full(seeds, -np.inf), np.zeros(seeds, np.int64), None)


def better_of(best: Best, score: Float[np.ndarray, " seeds"], step: int, actor: Any) -> Best:
    """Each seed's newest policy where its evaluation beats all earlier ones, else the policy as it was. NaN beats nothing."""
    better = np.asarray(score) > best.score
    if best.actor is None:
        kept = jax.tree.map(np.asarray, actor)
    else:

        def chosen(old: Any, new: Any) -> np.ndarray:
            return np.where(better.reshape(-1, *[1] * (old.ndim - 1)), np.asarray(new), np.asarray(old))

        kept = jax.tree.map(chosen, best.actor, actor)
    return Best(np.where(better, score, best.score), np.where(better, step, best.step), kept)


def save(directory: Path, best: Best) -> None:
    """Write it into a checkpoint's directory. Raises `LareError` where it cannot be written."""
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(best).items()}
    directory.mkdir(exist_ok=True)
    write_atomically(directory / FILE, lambda file: np.savez(file, allow_pickle=False, **arrays))


def load(directory: Path, shapes: Any, seeds: Sequence[int]) -> Best:
    """Read it from a checkpoint's directory.

    Args:
        directory: of the checkpoint.
        shapes: an actor, whose leaves may be only shapes.
        seeds: of the run.

    Raises:
        LareError: there is none, or it is of another structure.
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
