import json
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.errors import LareError
from lare_rl.runs import checkpoint

ROWS = 16


class Held(NamedTuple):
    columns: Any
    next_row: Any


class Learner(NamedTuple):
    replay: Held


def blank(*shape):
    return Learner(Held({"reward": jnp.zeros(shape)}, jnp.zeros(shape[:-1], int)))


def save(directory, buffer, end):
    """Of one seed; of one environment, or of several."""
    buffer, end = np.atleast_2d(buffer), np.atleast_1d(end)
    learner = Learner(Held({"reward": jnp.asarray(buffer[None], jnp.float32)}, jnp.asarray(end[None])))
    checkpoint.save(directory, learner, {"step": int(end.sum())}, {})


@settings(max_examples=40, deadline=None)
@given(moves=st.lists(st.tuples(st.integers(-12, 12), st.integers(-12, 12)), min_size=1, max_size=12))
def test_whatever_is_written_and_dropped_the_rows_that_are_held_come_back(moves, tmp_path_factory):
    """Rows are numbered from 1 on as they are written; a move back drops some, whose places are written anew.

    Two environments, each of which moves as it likes.
    """
    directory, buffer = tmp_path_factory.mktemp("run") / "checkpoint", np.zeros((2, ROWS))
    end, furthest, written = np.zeros(2, int), np.zeros(2, int), 0
    save(directory, buffer, end)
    for move in moves:
        for env in (0, 1):
            for _ in range(move[env]):
                written += 1
                buffer[env, end[env] % ROWS] = written
                end[env] += 1
            furthest[env] = max(furthest[env], end[env])
            if move[env] < 0:
                end[env] = max(end[env] + move[env], 0)
        save(directory, buffer, end)
        found, host, _ = checkpoint.load(directory, blank(1, 2, ROWS))
        assert host == {"step": end.sum()}
        np.testing.assert_array_equal(found.replay.next_row, [end])
        for env in (0, 1):
            held = np.arange(max(0, furthest[env] - ROWS + 1), end[env]) % ROWS  # the others were written over
            np.testing.assert_array_equal(
                found.replay.columns["reward"][0, env, held], buffer[env, held].astype(np.float32)
            )
        with np.load(directory / "state.npz") as state:
            kept = {f"rows-{one['number']}.npz" for one in json.loads(str(state["segments"]))}
        assert {path.name for path in directory.iterdir()} == kept | {"state.npz"}


@pytest.mark.parametrize("left", [0, 1, 100, 200])
@pytest.mark.parametrize("name", ["state.npz", "rows-0.npz"])
def test_a_file_that_is_not_whole(name, left, tmp_path):
    directory = tmp_path / "checkpoint"
    save(directory, np.zeros(ROWS), 3)
    content = (directory / name).read_bytes()
    (directory / name).write_bytes(content[:left])
    with pytest.raises(LareError, match=r"the checkpoint .*state\.npz cannot be read: "):
        checkpoint.load(directory, blank(1, 1, ROWS))
    host = checkpoint.saved_host(directory)
    assert (host is None) if name == "state.npz" else (host is not None and host["step"] == 3)


def test_a_segment_from_before_a_dropped_episode_outlives_a_newer_one(tmp_path):
    """At 40 of 100 the episode since row 10 was dropped: rows 0 to 40 are of more use for longer than row 10 alone."""
    buffer = np.arange(100.0)
    for end in (0, 40, 10, 60, 125):
        save(tmp_path / "checkpoint", buffer, end)
    found, _, _ = checkpoint.load(tmp_path / "checkpoint", blank(1, 1, 100))
    np.testing.assert_array_equal(found.replay.columns["reward"][0, 0, 25:], buffer[25:].astype(np.float32))


def test_a_bit_that_makes_another_compression_of_it(tmp_path):
    directory = tmp_path / "checkpoint"
    save(directory, np.zeros(ROWS), 3)
    content = bytearray((directory / "state.npz").read_bytes())
    content[content.index(b"PK\x01\x02") + 10] ^= 64
    (directory / "state.npz").write_bytes(content)
    with pytest.raises(
        LareError, match=r"state\.npz cannot be read: \.replay\.next_row\.npy is packed, which no checkpoint is"
    ):
        checkpoint.load(directory, blank(1, 1, ROWS))


def test_what_a_killed_process_left_makes_room(tmp_path):
    directory = tmp_path / "checkpoint"
    save(directory, np.zeros(ROWS), 3)
    (directory / "rows-1.npz.0123.new").write_bytes(b"half")
    save(directory, np.zeros(ROWS), 5)
    assert {path.name for path in directory.iterdir()} == {"rows-0.npz", "rows-1.npz", "state.npz"}


def test_a_checkpoint_of_other_sizes(tmp_path):
    save(tmp_path / "checkpoint", np.zeros(ROWS), 3)
    with pytest.raises(LareError, match=r"cannot be read: \.replay\.next_row has shape \(1, 1\), not \(1, 2\)"):
        checkpoint.load(tmp_path / "checkpoint", blank(1, 2, ROWS))
