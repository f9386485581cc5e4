"""Minari data sets. r_hat replaces the rewards; the old ones are in `infos["paid"]`, whose first entry belongs to the reset."""

import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.assigner.layout import layout_of
from lare_rl.errors import LareError, needs_extra, shortened
from lare_rl.logs.episode import Form, Hints, Logged, Paid, checked
from lare_rl.logs.output import check_free, whole

try:
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_dataset import MinariDataset, parse_dataset_id
    from minari.dataset.minari_storage import MinariStorage
    from minari.namespace import create_namespace, list_local_namespaces
    from minari.storage.datasets_root_dir import get_dataset_path
except ImportError as missing:
    raise needs_extra("a Minari data set", "minari") from missing

COPIED = (
    *("author", "author_email", "code_permalink", "algorithm_name", "requirements", "eval_env_spec"),
    *("ref_min_score", "ref_max_score", "num_episodes_average_score"),
)
"""Keys of a data set's metadata that are copied."""


class MinariLogs:
    """A data set of one agent, with any spaces that can be written as rows of numbers."""

    def __init__(self, dataset: Any, hints: Hints):
        self.dataset: MinariDataset = dataset
        self.name = str(dataset.spec.dataset_id)
        self.count: int | None = int(dataset.total_episodes)
        if not self.count:
            raise LareError(f"{self.name} has no episode")
        spec = dataset.env_spec
        limit = hints.limit or (spec.max_episode_steps if spec is not None else None)
        observation = layout_of(dataset.observation_space, f"the observation space of {self.name}")
        self.form = Form(observation, layout_of(dataset.action_space, f"the action space of {self.name}"), limit)

    def episodes(self) -> Iterator[Logged]:
        """Read one episode at a time, in the order of their numbers."""
        indices = self.dataset.episode_indices
        storage = self.dataset.storage
        both = zip(storage.get_episodes(indices), storage.get_episode_metadata(indices), strict=True)
        for number in indices.tolist():
            name = f"{self.name}, episode {number}"
            try:
                values, about = next(both)
            except Exception as error:  # h5py, pyarrow and Minari may raise anything for a file that is not trusted
                raise LareError(f"{name} cannot be read: {shortened(error)}") from error
            values = {key: value for key, value in values.items() if key != "id"}
            infos = values.get("infos") or {}
            if "paid" in infos:
                values["paid"] = np.asarray(infos["paid"])[1:]
            yield checked(name, values, self.form, {**values, "infos": infos, "seed": about.get("seed")})

    def check_out(self, out: str | Path, overwrite: bool) -> None:
        """Check the Minari id to write."""
        path = path_of(out)
        if path.parent.exists():  # if it does not, `write` creates the namespace
            check_free(path, overwrite)

    def write(self, out: str | Path, episodes: Iterable[Paid], overwrite: bool, about: str) -> str | Path:
        """Write a data set with another id, in the same format."""
        path, dataset_id, source = path_of(out), str(out), self.dataset.storage
        namespace, _, _ = parse_dataset_id(dataset_id)
        if namespace is not None and namespace not in list_local_namespaces():
            create_namespace(namespace)
        metadata = source.metadata
        with whole(path, overwrite) as new, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Minari warns if the spec of an environment cannot be saved
            new.mkdir()
            storage = MinariStorage.new(
                new / "data",
                source.observation_space,
                source.action_space,
                self.dataset.env_spec,
                source.FORMAT,
                jpeg_encoding=source.jpeg_encoding,
            )
            storage.update_metadata(
                {
                    **{key: metadata[key] for key in COPIED if metadata.get(key) is not None},
                    "dataset_id": dataset_id,
                    "minari_version": minari.__version__,
                    "description": f"{metadata.get('description') or self.name}\n\n{about}",
                }
            )
            storage.update_episodes(buffer_of(paid, source.FORMAT) for paid in episodes)
        return dataset_id


def flat(infos: dict[str, Any]) -> dict[str, Any]:
    """Rows of single numbers as lists: Minari writes them into Arrow as arrays, and cannot read those again."""
    return {
        key: flat(one)
        if isinstance(one, dict)
        else one.tolist()
        if np.ndim(one) == 1 and hasattr(one, "tolist")
        else one
        for key, one in infos.items()
    }


def buffer_of(paid: Paid, data_format: str) -> EpisodeBuffer:
    """An episode in the form that Minari writes."""
    kept = paid.episode.kept
    infos = {**kept["infos"], "paid": np.append(0.0, paid.episode.paid)}
    return EpisodeBuffer(
        seed=kept["seed"],
        observations=kept["observations"],
        actions=kept["actions"],
        rewards=paid.r_hat,  # pyright: ignore[reportArgumentType] - an array does as well
        terminations=kept["terminations"],
        truncations=kept["truncations"],
        infos=infos if data_format == "hdf5" else flat(infos),
    )


def load(dataset_id: str) -> MinariDataset:
    """A local data set. Raises `LareError` if there is none: nothing is downloaded."""
    try:
        return minari.load_dataset(dataset_id)
    except Exception as error:  # h5py and Minari may raise anything for files that are not trusted
        if not (get_dataset_path(dataset_id) / "data").exists():
            raise LareError(
                f"there is no {dataset_id}: neither a path nor a local data set of Minari (minari list local; "
                "minari download fetches one)"
            ) from error
        raise LareError(f"{dataset_id} cannot be read by Minari: {shortened(error)}") from error


def is_local(dataset_id: str) -> bool:
    """Whether there is a local Minari data set with that id."""
    return (get_dataset_path(dataset_id) / "data").is_dir()


def path_of(dataset_id: str | Path) -> Path:
    """The path of the data set with that id. Raises `LareError` if it is not an id."""
    try:
        parse_dataset_id(str(dataset_id))
    except (ValueError, TypeError):
        raise LareError(
            f"{dataset_id} is not a Minari id, such as cheetah/relabelled-v0: a name, -v and a number"
        ) from None
    return get_dataset_path(str(dataset_id))
