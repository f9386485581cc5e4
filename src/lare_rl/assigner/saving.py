"""Save a `CreditAssigner` to the disk, or send it to another process. No pickle.

DIRECTORY/
  assigner.json   the arguments that it was made with, and counts
  state.npz       decoder and statistics; steps and episodes, if they are saved; the steps on which phi is verified
  phi.py, .json   the function
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.assigner.layout import Layout
from lare_rl.assigner.store import Episode, Store
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import find_method
from lare_rl.errors import LareError, shortened
from lare_rl.latent.function import LatentFunction
from lare_rl.latent.saved import load as load_function
from lare_rl.runs.checkpoint import DAMAGED, opened
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.files import write_atomically
from lare_rl.util.safe_io import read_json, read_text

if TYPE_CHECKING:
    from lare_rl.assigner.assigner import CreditAssigner

FORMAT = 1
TEXT, ARRAYS, FUNCTION = "assigner.json", "state.npz", "phi.py"
TRIED = ("tried/observation", "tried/action")
"""The steps on which `phi` is verified when it is loaded, because there may be no environment."""


def text_of(credit: "CreditAssigner") -> dict[str, Any]:
    """The arguments that it was made with, and its counts, as JSON."""
    return {
        "format": FORMAT,
        "method": credit.config.method.name,
        "task": None if credit.config.task is None else credit.config.task.model_dump(mode="json"),
        "observation": credit.config.observation.model_dump(mode="json"),
        "action": credit.config.action.model_dump(mode="json"),
        "judges": credit.config.judges,
        "agents": credit.config.agents,
        "max_steps": credit.config.max_steps,
        "capacity": credit.store.capacity,
        "settings": credit.config.settings.model_dump(mode="json"),
        "seed": credit.config.seed,
        "fits_per_step": credit.config.fits_per_step,
        "scale_rewards": credit.config.scale_rewards,
        "forget": credit.config.forget,
        "phi": credit.config.phi is not None,
        "told": credit.learner.told,
        "fits": credit.learner.fits,
    }


def leaves(credit: "CreditAssigner") -> dict[str, Any]:
    """The arrays of the decoder and the statistics, by their paths."""
    found, _ = jax.tree_util.tree_flatten_with_path((credit.learner.state, credit.learner.scale))
    return {f"learned{jax.tree_util.keystr(path)}": leaf for path, leaf in found}


def arrays_of(credit: "CreditAssigner", episodes: bool) -> dict[str, np.ndarray]:
    """The learned state and, if `episodes` is true, the stored steps and episodes."""
    credit.learn()
    arrays = {name: np.asarray(leaf) for name, leaf in leaves(credit).items()}
    store = credit.store
    arrays["counts"] = np.array([store.ended, store.ended_steps, store.dropped + len(store.running)])
    for name, parts in zip(TRIED, zip(*credit.sample, strict=True), strict=False):
        arrays[name] = np.concatenate(parts)
    if not episodes:
        return arrays
    there = np.arange(max(0, store.steps - store.capacity), store.steps) % store.capacity
    kept = list(store.episodes.values())
    arrays |= {name: getattr(store, name)[there] for name in ("features", "length", "mean_reward")}
    arrays |= {} if store.alive is None else {"alive": store.alive[there]}
    arrays["steps"] = np.array(store.steps)
    arrays["episodes"] = np.concatenate([np.zeros(0, np.int64), *(one.steps for one in kept)])
    arrays["lengths"] = np.array([len(one.steps) for one in kept], np.int64)
    arrays["scores"] = np.array([one.score for one in kept], np.float64)
    return arrays


def save(credit: "CreditAssigner", directory: Path, episodes: bool) -> None:
    """Write a directory. Files of an earlier save are replaced, each as a whole."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LareError(f"{directory} cannot be written: {error.strerror}") from error
    arrays = arrays_of(credit, episodes)
    if credit.config.phi is not None:
        credit.config.phi.save(directory / FUNCTION)
    write_atomically(directory / ARRAYS, lambda file: np.savez(file, allow_pickle=False, **arrays))
    text = json.dumps(text_of(credit), indent=1).encode()
    write_atomically(directory / TEXT, lambda file: file.write(text))


def load(credit: "CreditAssigner", directory: Path) -> None:
    """Give an assigner, whose `__init__` has not been called, the state in a directory that `save` has written."""
    path = directory / TEXT
    try:
        text = read_json(read_text(path))
        with opened(directory / ARRAYS) as saved:
            arrays = {name: saved[name] for name in saved.files}
        if not isinstance(text, dict) or text.get("format") != FORMAT:
            raise LareError(f"{path} is not of format {FORMAT}: another version of LaRe has written it")
        tried = (arrays[TRIED[0]], arrays[TRIED[1]]) if set(TRIED) <= set(arrays) else None
        phi = load_function(directory / FUNCTION, TaskSpec(**text["task"]), steps=tried) if text["phi"] else None
        restore(credit, text, arrays, phi)
    except (*DAMAGED, TypeError, RecursionError) as error:
        raise LareError(
            f"{directory} holds no credit assigner, or one that is damaged or of another version: {shortened(error)}"
        ) from error


def restore(
    credit: "CreditAssigner", text: dict[str, Any], arrays: dict[str, np.ndarray], phi: LatentFunction | None
) -> None:
    """Give an assigner, whose `__init__` has not been called, the state of a saved one."""
    observation, action = Layout(**text["observation"]), Layout(**text["action"])
    task = None if text["task"] is None else TaskSpec(**text["task"])
    credit.__init__(
        find_method(text["method"]).name,
        phi,
        task=task,
        observation_space=observation,
        action_space=action,
        settings=CreditSettings(**text["settings"]),
        **{name: text[name] for name in ("judges", "agents", "max_steps", "capacity", "seed")},
        **{name: text[name] for name in ("fits_per_step", "scale_rewards", "forget")},
    )
    credit.learner.told, credit.learner.fits = text["told"], text["fits"]
    if set(TRIED) <= set(arrays):
        credit.sample.append((arrays[TRIED[0]], arrays[TRIED[1]]))
        credit.sampled = len(arrays[TRIED[0]])
    for name, leaf in leaves(credit).items():
        if arrays[name].shape != leaf.shape:
            raise ValueError(f"{name} has shape {arrays[name].shape}, not {leaf.shape}")
    learner, learned = credit.learner, [jnp.asarray(arrays[name]) for name in leaves(credit)]
    structure = jax.tree.structure((learner.state, learner.scale))
    learner.state, learner.scale = jax.tree.unflatten(structure, learned)
    store = credit.store
    store.ended, store.ended_steps, store.dropped = map(int, arrays["counts"])
    if "steps" in arrays:
        restore_steps(store, arrays)


def restore_steps(store: Store, arrays: dict[str, np.ndarray]) -> None:
    """Restore the stored steps and episodes."""
    store.steps = int(arrays["steps"])
    there = np.arange(max(0, store.steps - store.capacity), store.steps) % store.capacity
    for name in ("features", "length", "mean_reward"):
        getattr(store, name)[there] = arrays[name]
    if "alive" in arrays:
        store.alive = np.ones((store.capacity, store.features.shape[1]), bool)
        store.alive[there] = arrays["alive"]
    ends = np.cumsum(arrays["lengths"])
    first = store.ended - len(ends)
    for place, (end, length, score) in enumerate(zip(ends, arrays["lengths"], arrays["scores"], strict=True)):
        store.put(first + place, Episode(arrays["episodes"][end - length : end], float(score)))
