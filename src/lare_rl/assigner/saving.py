"""The state of a `CreditAssigner` as plain data, and its files. No pickle.

DIRECTORY/
  assigner.json   the arguments of the assigner, and counts
  state.npz       decoder and statistics; steps and episodes, if they are saved; the steps on which phi is verified
  phi.py, .json   the function
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lare_rl.assigner.assigner_config import AssignerConfig
from lare_rl.assigner.compiled_functions import on_cpu
from lare_rl.assigner.decoder_learner import DecoderLearner
from lare_rl.assigner.group_names import GroupName
from lare_rl.assigner.store import Store, StoredEpisode
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError
from lare_rl.latent.saved import load_function
from lare_rl.runs.checkpoint import fill_template, named_leaves
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.files import make_directory, replace_npz, write_bytes
from lare_rl.util.npz import open_npz
from lare_rl.util.renamed_fields import rename_assigner, rename_keys
from lare_rl.util.safe_io import read_json, read_text

__all__ = ["AssignerState", "get_state", "read_state", "restore", "write_state"]

FORMAT = 1
TEXT_FILE, ARRAYS_FILE, FUNCTION_FILE = "assigner.json", "state.npz", "phi.py"
LEARNED = "learned"
"""The prefix of the names of the decoder's arrays."""
STORE_ARRAYS = ("inputs", "length", "mean_reward", "episode")
"""The arrays of a store, for each step."""
PHI_SAMPLE = ("phi_sample/observation", "phi_sample/action")
"""The arrays on which `phi` is verified when it is loaded, because there may be no environment."""


@dataclass(frozen=True)
class AssignerState:
    """Everything that makes up an assigner."""

    config: AssignerConfig
    n_learned: int
    n_updates: int
    arrays: dict[str, np.ndarray]
    group_names: tuple[GroupName, ...] = ()
    """The groups in the order of their numbers."""


def get_state(learner: DecoderLearner, group_names: Iterable[GroupName], *, episodes: bool) -> AssignerState:
    """Return the state of an assigner, with stored steps and episodes if `episodes` is true."""
    learner.learn_returns()
    store = learner.store
    leaves = named_leaves((learner.decoder,))
    arrays = {LEARNED + name: np.asarray(leaf) for name, leaf in leaves.items()}
    n_lost = sum(not episode.is_abandoned for episode in store.running.values())  # running episodes are not saved
    counts = store.n_ended, store.n_ended_steps, store.dropped + n_lost, store.max_ended_steps, store.n_forgotten
    arrays["counts"] = np.array(counts)
    for name, chunks in zip(PHI_SAMPLE, zip(*learner.phi_sample, strict=True), strict=False):
        arrays[name] = np.concatenate(chunks)
    if episodes:
        arrays |= _store_arrays(store)
    return AssignerState(learner.config, learner.n_learned, learner.n_updates, arrays, tuple(group_names))


def restore(learner: DecoderLearner, state: AssignerState) -> None:
    """Give a new learner the state of a saved one. Raises `KeyError` or `ValueError` if the arrays do not fit."""
    arrays = rename_assigner(state.arrays)
    learner.n_learned, learner.n_updates = state.n_learned, state.n_updates
    if sample := _phi_sample(arrays):
        learner.phi_sample.append(sample)
    learned = {name.removeprefix(LEARNED): array for name, array in arrays.items()}
    with on_cpu():
        (learner.decoder,) = fill_template((learner.decoder,), learned)
    store = learner.store
    counts = arrays["counts"].tolist()
    counts += [0, 0, 0, 1, 0][len(counts) :]  # earlier versions have three or four
    store.n_ended, store.n_ended_steps, store.dropped, store.max_ended_steps, store.n_forgotten = map(int, counts)
    if "n_added" in arrays:
        _restore_store(store, arrays)


def write_state(state: AssignerState, directory: Path) -> None:
    """Write a directory. Files of an earlier save are replaced, each as a whole."""
    make_directory(directory)
    if state.config.phi is not None:
        state.config.phi.save(directory / FUNCTION_FILE)
    replace_npz(directory / ARRAYS_FILE, state.arrays)
    values = {
        **state.config.model_dump(mode="json", exclude={"method", "phi"}),
        "format": FORMAT,
        "method": state.config.method.name,
        "phi": state.config.phi is not None,
        "group_names": list(state.group_names),
        "n_learned": state.n_learned,
        "n_updates": state.n_updates,
    }
    write_bytes(directory / TEXT_FILE, json.dumps(values, indent=1).encode())


def read_state(directory: Path) -> AssignerState:
    """Read what `write_state` has written. `phi` is verified again. Damaged files raise `DAMAGED_FILE_ERRORS`.

    Raises:
        LareError: another version has written the directory, or `phi` fails.
    """
    path = directory / TEXT_FILE
    values = read_json(read_text(path))
    values = rename_assigner(rename_keys(values)) if isinstance(values, dict) else {}
    with open_npz(directory / ARRAYS_FILE) as saved:
        arrays = rename_assigner({name: saved[name] for name in saved.files})
    if values.get("format") != FORMAT:
        raise LareError(f"{path} is not of format {FORMAT}: another version of LaRe has written it")
    task = None if values["task"] is None else TaskSpec(**values["task"])
    phi = None
    if task is not None and values["phi"]:
        # A task may have no environment that plays random steps. `phi` is also verified on numbers that are not the environment's.
        sizes = task.observation_size, task.action_size
        zeros = np.zeros((1, sizes[0]), np.float32), np.zeros((1, sizes[1]), np.float32)
        phi = load_function(directory / FUNCTION_FILE, task, steps=_phi_sample(arrays) or zeros)
    if isinstance(values["settings"], dict):
        values["settings"].setdefault("start_value", False)  # of an earlier version
    fields = {name: values[name] for name in AssignerConfig.model_fields.keys() & values.keys()}
    config = AssignerConfig(**fields | {"method": METHODS.find(values["method"]), "phi": phi, "task": task})
    group_names = tuple(values.get("group_names", ()))
    return AssignerState(config, values["n_learned"], values["n_updates"], arrays, group_names)


def _phi_sample(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the arrays of `PHI_SAMPLE`, or None without them."""
    observation, action = map(arrays.get, PHI_SAMPLE)
    return None if observation is None or action is None else (observation, action)


def _store_arrays(store: Store) -> dict[str, np.ndarray]:
    rows = store.stored_rows
    numbers = [number for _, number in store.oldest]  # in the order from which batches are sampled
    episodes = [store.episodes[number] for number in numbers]
    return {
        **{name: getattr(store, name)[rows] for name in STORE_ARRAYS},
        **({} if store.alive is None else {"alive": store.alive[rows]}),
        "n_added": np.array(store.n_added),
        "numbers": np.array(numbers, np.int64),
        "episodes": np.concatenate([np.zeros(0, np.int64), *(episode.step_ids for episode in episodes)]),
        "lengths": np.array([len(episode.step_ids) for episode in episodes], np.int64),
        "scores": np.array([episode.return_ for episode in episodes], np.float64),
        "levels": np.array([episode.level for episode in episodes], np.int64),
    }


def _restore_store(store: Store, arrays: dict[str, np.ndarray]) -> None:
    store.n_added = int(arrays["n_added"])
    rows = store.stored_rows
    for name in STORE_ARRAYS:
        if name in arrays:  # earlier versions did not save every array
            getattr(store, name)[rows] = arrays[name]
    if "alive" in arrays:
        store.alive = np.ones((store.capacity, store.agents), bool)
        store.alive[rows] = arrays["alive"]
    ends = np.cumsum(arrays["lengths"])
    # Earlier versions saved neither levels nor numbers.
    levels = arrays.get("levels", np.zeros(len(ends), np.int64)).tolist()
    numbers = arrays.get("numbers", store.n_ended - len(ends) + np.arange(len(ends))).tolist()
    episodes = np.split(arrays["episodes"], ends)[:-1]
    scores = arrays["scores"].tolist()
    for number, step_ids, score, level in zip(numbers, episodes, scores, levels, strict=True):
        store.put_episode(number, StoredEpisode(step_ids, score, level))
    store.episodes = dict(sorted(store.episodes.items()))
