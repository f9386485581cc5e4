"""The choice of the stored steps that an update of a decoder reads: like `data/sampling.py`, for a `Store`, in NumPy."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Int

from lare_rl.assigner.store import Episode, Store
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decomposition import Episodes
from lare_rl.credit.methods import Fit


def batch(store: Store, fit: Fit, settings: CreditSettings, random: np.random.Generator, longest: int) -> Episodes:
    """Steps of episodes for one update, drawn uniformly with replacement.

    Args:
        store: a store with at least one episode.
        longest: the largest number of steps of an episode; batches with the same value have the same shape.
    """

    def drawn(some: int) -> list[Episode]:
        return [store.episodes[store.oldest[place][1]] for place in random.integers(len(store.oldest), size=some)]

    if fit is Fit.SUBTRAJECTORIES:
        return padded(store, drawn(settings.episodes), longest)
    if fit.draws_steps:
        chosen = drawn(max(1, settings.steps // settings.drawn_steps))
        return parts(store, chosen, settings.drawn_steps, random)
    rows = max(settings.steps, longest)
    mean = max(1, store.ended_steps // store.ended)
    return packed(store, drawn(max(1, settings.steps // mean)), max(1, settings.steps // 2), rows)


def parts(store: Store, episodes: Sequence[Episode], drawn: int, random: np.random.Generator) -> Episodes:
    """`drawn` steps of each episode, without replacement. A shorter episode gives all its steps, and padding."""
    steps = np.zeros((len(episodes), drawn), np.int64)
    belongs = np.zeros((len(episodes), drawn), bool)
    for place, episode in enumerate(episodes):
        count = min(drawn, len(episode.steps))
        steps[place] = episode.steps[0]
        steps[place, :count] = episode.steps[random.choice(len(episode.steps), count, replace=False, shuffle=False)]
        belongs[place, :count] = True
    number = np.where(belongs, np.arange(len(episodes))[:, None], len(episodes))
    return episodes_of(store, episodes, steps.ravel(), number.ravel(), len(episodes))


def packed(store: Store, episodes: Sequence[Episode], places: int, rows: int) -> Episodes:
    """Whole episodes one after the other, as many as fit, and padding."""
    chosen: list[Episode] = []
    used = 0
    for episode in episodes[:places]:
        if used + len(episode.steps) <= rows:
            chosen.append(episode)
            used += len(episode.steps)
    steps = np.concatenate([episode.steps for episode in chosen])
    number = np.repeat(np.arange(len(chosen)), [len(episode.steps) for episode in chosen])
    more = rows - len(steps)
    steps, number = np.pad(steps, (0, more), mode="edge"), np.pad(number, (0, more), constant_values=places)
    return episodes_of(store, chosen, steps, number, places)


def padded(store: Store, episodes: Sequence[Episode], longest: int) -> Episodes:
    """Whole episodes. The last step of each is repeated until there are `longest`."""
    steps = np.concatenate(
        [np.pad(episode.steps, (0, longest - len(episode.steps)), mode="edge") for episode in episodes]
    )
    return episodes_of(store, episodes, steps, np.repeat(np.arange(len(episodes)), longest), len(episodes))


def episodes_of(
    store: Store,
    episodes: Sequence[Episode],
    steps: Int[np.ndarray, " rows"],
    number: Int[np.ndarray, " rows"],
    places: int,
) -> Episodes:
    """The features of some steps, with the returns of their episodes."""
    rows, count = steps % store.capacity, len(episodes)
    length, score = np.ones(places, np.int32), np.zeros(places)
    length[:count] = [len(episode.steps) for episode in episodes]
    score[:count] = [episode.score for episode in episodes]
    share = None
    if store.alive is not None:
        alive = store.alive[rows]
        share = (alive / np.maximum(alive.sum(axis=-1, keepdims=True), 1)).astype(np.float32)
    features = store.features[rows]
    return Episodes(
        features=features,  # pyright: ignore[reportArgumentType]
        episode=number.astype(np.int32),  # pyright: ignore[reportArgumentType]
        length=length,  # pyright: ignore[reportArgumentType]
        mean_reward=(score / length).astype(np.float32),  # pyright: ignore[reportArgumentType]
        mask=(np.arange(places) < count).astype(np.float32),  # pyright: ignore[reportArgumentType]
        share=share,  # pyright: ignore[reportArgumentType]
    )


def pieces(store: Store, episodes: Sequence[Episode], places: int, rows: int) -> Iterator[Episodes]:
    """Whole episodes in their order, some at a time: at most `places` of them, in `rows` rows with padding."""
    start = 0
    while start < len(episodes):
        end, used = start, 0
        while end < len(episodes) and end - start < places and used + len(episodes[end].steps) <= rows:
            used += len(episodes[end].steps)
            end += 1
        yield packed(store, episodes[start:end], places, rows)
        start = end
