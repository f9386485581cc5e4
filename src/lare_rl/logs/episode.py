"""One logged episode, checked: no log is trusted, and a value that does not fit raises a `LareError` with file and key."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.assigner.layout import Layout
from lare_rl.errors import LareError, shortened

LARGEST = 1e18
"""Numbers of a log are smaller: their squares are summed in float32."""
KEYS = (
    *("observations", "actions", "rewards", "score", "next_observations"),
    *("terminations", "truncations", "cut", "paid"),
)
NEEDED = "observations, actions, and rewards or a score"


@dataclass(frozen=True)
class Logged:
    """An episode of T steps."""

    name: str
    """The file or the place of the episode, for messages."""
    before: Float[np.ndarray, "steps observation"]
    action: Float[np.ndarray, "steps action"]
    after: Float[np.ndarray, "steps observation"]
    paid: Float[np.ndarray, " steps"]
    """The original reward of each step. A score is that of the last step."""
    whole: bool
    """Whether the episode was not cut, so that its return can be learned from."""
    kept: Any = field(repr=False)
    """The contents of its file, to write them again."""

    def __len__(self) -> int:
        return len(self.paid)


@dataclass(frozen=True)
class Form:
    """The form that all episodes of a log have in common."""

    observation: Layout
    action: Layout
    limit: int | None = None
    """Steps after which the time limit ends an episode; None if it is not known."""


class Paid(NamedTuple):
    """An episode with its new rewards."""

    episode: Logged
    r_hat: Float[np.ndarray, " steps"]


class Hints(NamedTuple):
    """What a task says about its logs."""

    sizes: Mapping[str, int]
    """Sizes of `observation` and `action` rows."""
    limit: int | None
    """The time limit, in steps."""


def checked(name: str, values: Mapping[str, Any], form: Form, kept: Any) -> Logged:
    """An episode from the contents of its file.

    Args:
        name: name of the file, or of the episode in it.
        values: `observations` (T + 1, ...) or, with `next_observations` (T, ...), (T, ...); `actions` (T, ...); `rewards` (T,) or
            `score`, a single number. Optional: `terminations` and `truncations`, (T,) or one flag; `cut`, one flag; `paid` (T,),
            the rewards before they were relabelled.
        form: the form of all episodes.
        kept: the contents of the file, to write them again.

    Raises:
        LareError: something is missing, of another shape or type, or not finite.
    """
    for key in ("observations", "actions"):
        if key not in values:
            raise LareError(f"{name} has no {key}: an episode has {NEEDED}")
    action = rows(name, "actions", values["actions"], form.action)
    shown = rows(name, "observations", values["observations"], form.observation)
    steps = len(action)
    if not steps:
        raise LareError(f"{name}: actions has no step")
    if "next_observations" in values:
        before, after = shown, rows(name, "next_observations", values["next_observations"], form.observation)
        wanted, there = f"{steps}, one for each action", (len(before), len(after))
    else:
        before, after = shown[:-1], shown[1:]
        wanted, there = f"{steps + 1}, one more than there are actions (or give next_observations)", (len(before),)
    if set(there) != {steps}:
        what = "observations and next_observations" if "next_observations" in values else "observations"
        raise LareError(f"{name}: {what} must have {wanted}, and the shape of observations is {shown.shape}")
    return Logged(name, before, action, after, paid(name, values, steps), is_whole(name, values, steps, form), kept)


def rows(name: str, key: str, values: Any, layout: Layout) -> Float[np.ndarray, "steps size"]:
    """An array of a file as rows of numbers."""
    where = f"{name}: {key}"
    for part in leaves(values):
        if part.dtype.kind not in "biuf":
            raise LareError(f"{where} must be numbers, and is of type {part.dtype}")
        with np.errstate(all="ignore"):
            small = not part.size or np.abs(part.astype(np.float64)).max() <= LARGEST  # which is false for nan
        if not small:
            raise LareError(f"{where} holds a number that is not finite, or larger than {LARGEST:g}")
    found = layout.rows(values, where)
    if found.ndim != 2:
        raise LareError(f"{where} must be (steps, {layout.size}) in rows, and is {found.shape}")
    return found


def leaves(values: Any) -> list[np.ndarray]:
    """The arrays in a mapping or a tuple of them, or the array itself."""
    if isinstance(values, dict):
        return [leaf for part in values.values() for leaf in leaves(part)]
    if isinstance(values, tuple):
        return [leaf for part in values for leaf in leaves(part)]
    return [np.asarray(values)]


def paid(name: str, values: Mapping[str, Any], steps: int) -> Float[np.ndarray, " steps"]:
    """The original rewards of an episode: those before it was relabelled, if it was."""
    key = next((key for key in ("paid", "score", "rewards") if key in values), None)
    if key is None:
        raise LareError(f"{name} has no rewards and no score: an episode has {NEEDED}")
    found = np.asarray(values[key])
    if found.dtype.kind not in "biuf":
        raise LareError(f"{name}: {key} must be numbers, and is of type {found.dtype}")
    with np.errstate(all="ignore"):
        found, shape = found.astype(np.float64), () if key == "score" else (steps,)
        small = np.abs(found).sum() <= LARGEST  # which is false for nan
    if found.shape != shape:
        wanted = f"one reward for each of {steps} steps" if shape else "a single number"
        raise LareError(f"{name}: {key} must be {wanted}, and its shape is {found.shape}")
    if not small:
        raise LareError(f"{name}: {key} holds a number that is not finite, or larger than {LARGEST:g}")
    return found if shape else np.append(np.zeros(steps - 1), found)


def is_whole(name: str, values: Mapping[str, Any], steps: int, form: Form) -> bool:
    """Whether an episode is complete: it terminated, or the time limit ended it.

    If the time limit is not known, every truncated episode counts as ended by it. Without any flags, every episode is whole.
    """
    ends = {key: flag_at_end(name, key, values, steps) for key in ("terminations", "truncations")}
    if flag_at_end(name, "cut", values, steps):
        return False
    if ends["terminations"] or all(flag is None for flag in ends.values()):
        return True
    return bool(ends["truncations"]) if form.limit is None else steps >= form.limit


def flag_at_end(name: str, key: str, values: Mapping[str, Any], steps: int) -> bool | None:
    """The flag of the last step; None if there is no flag."""
    if key not in values:
        return None
    flags = np.asarray(values[key])
    if flags.dtype.kind not in "biuf" or not np.isin(flags, (0, 1)).all():
        raise LareError(f"{name}: {key} must be true or false, and is {shortened(flags)}")
    if flags.shape not in ((), (1,), (steps,)):
        raise LareError(f"{name}: {key} must be one flag for each of {steps} steps, and its shape is {flags.shape}")
    flat = np.atleast_1d(flags).astype(bool)
    if key != "cut" and flat[:-1].any():
        raise LareError(f"{name}: {key} ends the episode at step {int(flat.argmax())} of {steps}")
    return bool(flat.any() if key == "cut" else flat[-1])


def form_of(name: str, values: Mapping[str, Any], sizes: Mapping[str, int], limit: int | None) -> Form:
    """The form of a log without spaces, from its first episode.

    Args:
        name: name of the episode.
        values: the contents of its file.
        sizes: sizes of `observation` and `action` rows, if a task gives them.
        limit: the time limit, if it is known.

    Raises:
        LareError: actions are whole numbers, and the number of choices is not known.
    """
    found = {}
    for kind in ("observation", "action"):
        array = np.asarray(values.get(f"{kind}s", np.zeros((0, 0))))
        size = sizes.get(kind)
        chosen = array.dtype.kind in "iu" and array.ndim == 1
        if chosen and size is None:
            raise LareError(
                f"{name}: {kind}s are whole numbers, choices maybe: write a task file that says how many there are ({kind}_size), "
                "as docs/logs.md shows, and give it (--task FILE)"
            )
        if chosen and size != 1:
            found[kind] = Layout(kind="choices", choices=(int(size or 0),), first=(0,))
        else:
            found[kind] = Layout(kind="numbers", shape=array.shape[1:])
    return Form(found["observation"], found["action"], limit)
