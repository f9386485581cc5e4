"""Minari data sets. r_hat replaces the rewards. The original ones are in `infos["paid"]`, whose first entry belongs to the reset."""

import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.assigner.space_layout import make_layout
from lare_rl.errors import LareError, missing_extra_error, short_repr
from lare_rl.logs.episode import LogLayout, RelabelledEpisode
from lare_rl.logs.log import Log, atomic_output, check_output
from lare_rl.tasks.spec import TaskSpec

try:
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_dataset import MinariDataset, parse_dataset_id
    from minari.dataset.minari_storage import MinariStorage
    from minari.namespace import create_namespace, list_local_namespaces
    from minari.storage.datasets_root_dir import get_dataset_path
except ImportError as missing:
    raise missing_extra_error("a Minari data set", "minari") from missing

__all__ = ["MinariLog", "is_local_dataset", "load_dataset"]

COPIED_METADATA = (
    "author", "author_email", "code_permalink", "algorithm_name", "requirements", "eval_env_spec",
    "ref_min_score", "ref_max_score", "num_episodes_average_score",
)  # fmt: skip

DATA_FOLDER = "data"
"""The only folder in the directory of a data set."""


class MinariLog(Log):
    """A data set of one agent, with spaces that can be written as rows of numbers."""

    def __init__(self, dataset: Any, role: TaskSpec | None):
        self.dataset: MinariDataset = dataset
        self.name = str(dataset.spec.dataset_id)
        self.n_episodes = int(dataset.total_episodes)
        self.description = str(dataset.storage.metadata.get("description") or "")
        if not self.n_episodes:
            raise LareError(f"{self.name} has no episode")
        self.group_key = None if role is None else role.group
        max_episode_steps = None if role is None else role.max_episode_steps
        if max_episode_steps is None and dataset.env_spec is not None:
            max_episode_steps = dataset.env_spec.max_episode_steps
        self.layout = LogLayout(
            observation=make_layout(dataset.observation_space, f"the observation space of {self.name}"),
            action=make_layout(dataset.action_space, f"the action space of {self.name}"),
            max_episode_steps=max_episode_steps,
            has_groups=self.group_key is not None and "group" in next(self.read())[1],
        )

    def read(self) -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
        indices, storage = self.dataset.episode_indices, self.dataset.storage
        records = zip(storage.get_episodes(indices), storage.get_episode_metadata(indices), strict=True)
        for number in indices.tolist():
            name = f"{self.name}, episode {number}"
            try:
                values, metadata = next(records)
            except Exception as error:  # h5py, pyarrow and Minari may raise anything for an untrusted file
                raise LareError(f"{name} cannot be read: {short_repr(error)}") from error
            values = {key: value for key, value in values.items() if key != "id"}
            infos = values.get("infos") or {}
            if "paid" in infos:
                values["paid"] = np.asarray(infos["paid"])[1:]
            if self.group_key in infos:
                group = np.atleast_1d(np.asarray(infos[self.group_key], object))[-1]
                text = group.decode(errors="replace") if isinstance(group, bytes) else group  # HDF5 has bytes
                values["group"] = np.array([text], object)
            reset = {key: metadata.get(key) for key in ("seed", "options")}
            yield name, values, {**values, **reset, "infos": infos}

    def check_output(self, out: str | Path, overwrite: bool) -> None:
        """Raise `LareError` if no data set with the id `out` can be written."""
        path = _dataset_path(out)
        if path.parent.exists():  # otherwise `write` creates the namespace
            check_output(path, overwrite, (DATA_FOLDER,))

    def write(self, out: str | Path, episodes: Iterable[RelabelledEpisode], overwrite: bool, comment: str) -> str:
        """Write a data set with the id `out`, in the same format."""
        path, dataset_id, source = _dataset_path(out), str(out), self.dataset.storage
        namespace, _, _ = parse_dataset_id(dataset_id)
        if namespace is not None and namespace not in list_local_namespaces():
            create_namespace(namespace)
        metadata = source.metadata
        with atomic_output(path, overwrite, (DATA_FOLDER,)) as directory, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Minari warns if the spec of an environment cannot be saved
            directory.mkdir()
            storage = MinariStorage.new(
                directory / DATA_FOLDER,
                source.observation_space,
                source.action_space,
                self.dataset.env_spec,
                source.FORMAT,
                jpeg_encoding=source.jpeg_encoding,
            )
            storage.update_metadata(
                {
                    **{key: metadata[key] for key in COPIED_METADATA if metadata.get(key) is not None},
                    "dataset_id": dataset_id,
                    "minari_version": minari.__version__,
                    "description": f"{self.description or self.name}\n\n{comment}",
                }
            )
            storage.update_episodes(_episode_buffer(item, source.FORMAT) for item in episodes)
        return dataset_id


def load_dataset(dataset_id: str) -> MinariDataset:
    """Load a local data set. Nothing is downloaded. Raises `LareError` if there is no such data set, or it is damaged."""
    try:
        return minari.load_dataset(dataset_id)
    except Exception as error:  # h5py and Minari may raise anything for untrusted files
        if not is_local_dataset(dataset_id):
            raise LareError(
                f"{dataset_id} is neither a path nor a local Minari data set: see minari list local; minari download fetches one"
            ) from error
        raise LareError(f"{dataset_id} cannot be read by Minari: {short_repr(error)}") from error


def is_local_dataset(dataset_id: str) -> bool:
    """Return whether a local Minari data set has that id."""
    return (get_dataset_path(dataset_id) / DATA_FOLDER).is_dir()


def _dataset_path(dataset_id: str | Path) -> Path:
    try:
        parse_dataset_id(str(dataset_id))
    except (ValueError, TypeError):
        raise LareError(
            f"{dataset_id} is not a Minari id, such as cheetah/relabelled-v0: a name, -v and a number"
        ) from None
    return get_dataset_path(str(dataset_id))


def _episode_buffer(item: RelabelledEpisode, data_format: str) -> EpisodeBuffer:
    contents = item.episode.contents
    infos = {**contents["infos"], "paid": np.append(0.0, item.episode.reward)}
    return EpisodeBuffer(
        seed=contents["seed"],
        options=contents["options"],
        observations=contents["observations"],
        actions=contents["actions"],
        rewards=item.r_hat,  # pyright: ignore[reportArgumentType] - an array works as well
        terminations=contents["terminations"],
        truncations=contents["truncations"],
        infos=infos if data_format == "hdf5" else _flat_arrays_to_lists(infos),
    )


def _flat_arrays_to_lists(infos: dict[str, Any]) -> dict[str, Any]:
    """Convert arrays with one axis to lists, because Minari cannot read such an array again from Arrow."""

    def convert(value: Any) -> Any:
        if isinstance(value, dict):
            return _flat_arrays_to_lists(value)
        return value.tolist() if isinstance(value, np.ndarray) and value.ndim == 1 else value

    return {key: convert(value) for key, value in infos.items()}
