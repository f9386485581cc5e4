"""Batches of stored episodes, for the fits of a decoder."""

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from lare_rl.assigner import compiled_functions as compiled
from lare_rl.assigner.compiled_functions import MAX_CALL_STEPS
from lare_rl.assigner.store import Store, StoredEpisode
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.descent import plan_batch
from lare_rl.credit.spec import CreditSpec
from lare_rl.data.layouts import Layout, lay_out_packed, lay_out_padded, lay_out_sampled
from lare_rl.util.rows import pad_rows, padded_size

__all__ = ["pack_in_order", "sample_batch", "whole_episodes"]


def sample_batch(store: Store, spec: CreditSpec, random: np.random.Generator, longest: int) -> CreditBatch:
    """Sample the steps of one gradient update, from episodes that are sampled uniformly with replacement.

    The store needs an episode. `longest` is the most steps of an episode; batches for the same `longest` have the same shape.
    """
    plan = plan_batch(spec, longest)
    if plan.layout == "packed":
        count = max(1, spec.settings.batch_steps * store.n_ended // store.n_ended_steps)
        return _pack(store, _sample_episodes(store, count, random)[: plan.episodes], plan.episodes, plan.rows)
    episodes = _sample_episodes(store, plan.episodes, random)
    length = _lengths(episodes)
    if plan.layout == "padded":
        return _gather(store, episodes, lay_out_padded(length, plan.rows), len(episodes))
    key = jax.random.key(int(random.integers(2**31)))
    step = np.asarray(compiled.sample_step_numbers(key, length.astype(np.int32), steps=plan.rows))
    return _gather(store, episodes, lay_out_sampled(length, step), len(episodes))


def whole_episodes(store: Store, spec: CreditSpec, episodes: Sequence[StoredEpisode]) -> Iterator[CreditBatch]:
    """Yield batches of whole episodes, in their order. Rows are padded to one of two sizes, so that few programs are compiled."""
    lengths = _lengths(episodes)
    longest = int(lengths.max(initial=1))
    rows = padded_size(longest)
    if lengths.sum() > rows:
        rows = padded_size(max(longest, min(MAX_CALL_STEPS // spec.agents, spec.prediction_window * longest)))
    return pack_in_order(store, episodes, spec.prediction_window, rows)


def pack_in_order(store: Store, episodes: Sequence[StoredEpisode], n_episodes: int, rows: int) -> Iterator[CreditBatch]:
    """Yield whole episodes in their order, in batches of at most `n_episodes` episodes in `rows` rows, which the longest must fit."""
    start = 0
    while start < len(episodes):
        batch = _pack(store, episodes[start : start + n_episodes], n_episodes, rows)
        yield batch
        start += int(batch.mask.sum())


def _sample_episodes(store: Store, count: int, random: np.random.Generator) -> list[StoredEpisode]:
    return [store.episodes[store.oldest[i][1]] for i in random.integers(len(store.oldest), size=count)]


def _lengths(episodes: Sequence[StoredEpisode]) -> Int[np.ndarray, " episodes"]:
    return np.array([len(episode.step_ids) for episode in episodes], int)


def _pack(store: Store, episodes: Sequence[StoredEpisode], n_episodes: int, rows: int) -> CreditBatch:
    """Put whole episodes one after the other. Episodes that do not fit into the rows are left out."""
    length = _lengths(episodes)
    layout, mask = lay_out_packed(length, np.ones(len(length)), rows)
    episodes = episodes[: int(mask.sum())]
    is_step = layout.episode_index < len(episodes)
    return _gather(
        store, episodes, Layout(np.where(is_step, layout.episode_index, n_episodes), layout.step), n_episodes
    )


def _gather(store: Store, episodes: Sequence[StoredEpisode], layout: Layout, n_episodes: int) -> CreditBatch:
    """Return the inputs of the steps of a layout, with the returns of their episodes. The batch has room for `n_episodes` episodes.

    The layout has an axis of episodes, or none. Its padding reads some stored step.
    """
    count, lengths = len(episodes), _lengths(episodes)
    first = np.cumsum(lengths) - lengths
    index = np.arange(count)[:, None] if layout.episode_index.ndim > 1 else np.minimum(layout.episode_index, count - 1)
    steps = np.concatenate([episode.step_ids for episode in episodes])[first[index] + layout.step].ravel()
    rows, mask = steps % store.capacity, np.arange(n_episodes) < count
    length = np.where(mask, pad_rows(lengths, n_episodes), 1).astype(np.int32)
    score = pad_rows(np.array([episode.return_ for episode in episodes]), n_episodes)
    level = pad_rows(np.array([episode.level for episode in episodes], np.int32), n_episodes)
    arrays: dict[str, Any] = {
        "inputs": store.inputs[rows],
        "episode_index": layout.episode_index.ravel().astype(np.int32),
        "length": length,
        "mean_reward": (score / length).astype(np.float32),
        "mask": mask.astype(np.float32),
        "alive": None if store.alive is None else store.alive[rows],
        "level": level if store.has_levels else None,
    }
    return CreditBatch(**arrays)
