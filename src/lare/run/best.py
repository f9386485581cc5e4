"""The policy of each seed's best evaluation, kept beside the last checkpoint.

    checkpoint/best.npz     what is needed to act, by its place; `score` and `step` of each seed

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
from lare.run.checkpoint import DAMAGED, opened

FILE = "best.npz"


class Best(NamedTuple):
    """Of each seed."""

    score: Float[np.ndarray, " seeds"]
    """The mean return of its best evaluation; -inf before the first."""
    step: Int[np.ndarray, " seeds"]
    """When that was."""
    actor: Any
    """What was needed to act then. None before the first evaluation."""


def none_yet(seeds: int) -> Best:
    """Before the first evaluation."""
    return Best(np.full(seeds, -np.inf), np.zeros(seeds, np.int64), None)


def better_of(best: Best, score: Float[np.ndarray, " seeds"], step: int, actor: Any) -> Best:
    """With the newest policy of those seeds whose evaluation was better than every one before. NaN is never better."""
    better = np.asarray(score) > best.score
    if best.actor is None:
        kept = jax.tree.map(np.asarray, actor)
    else:

        def chosen(old: np.ndarray, new: Any) -> np.ndarray:
            return np.where(better.reshape(-1, *[1] * (old.ndim - 1)), np.asarray(new), old)

        kept = jax.tree.map(chosen, best.actor, actor)
    return Best(np.where(better, score, best.score), np.where(better, step, best.step), kept)


def save(directory: Path, best: Best) -> None:
    """Write it into a checkpoint's directory. Raises `LareError` where it cannot be written."""
    arrays = {place: np.asarray(leaf) for place, leaf in by_place(best.actor)}
    arrays |= {"score": best.score, "step": best.step}
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
            leaves = [as_shaped(saved[place], leaf, place) for place, leaf in by_place(shapes)]
            score, step = (
                as_shaped(saved[name], np.zeros(len(seeds), kind), name)
                for name, kind in (("score", float), ("step", int))
            )
    except DAMAGED as error:
        raise LareError(f"{path} cannot be read: {error or type(error).__name__}") from error
    return Best(score, step, jax.tree.unflatten(jax.tree.structure(shapes), leaves))


def by_place(actor: Any) -> list[tuple[str, Any]]:
    """Every array of it, with its place as a name."""
    return [
        (f"actor{jax.tree_util.keystr(path)}", leaf) for path, leaf in jax.tree_util.tree_flatten_with_path(actor)[0]
    ]


def as_shaped(array: np.ndarray, like: Any, name: str) -> np.ndarray:
    """The array. Raises `ValueError` where it has not the shape and type that it should have."""
    if array.shape != like.shape or array.dtype != like.dtype:
        raise ValueError(f"{name} is {array.dtype}{list(array.shape)}, not {like.dtype}{list(like.shape)}")
    return array
