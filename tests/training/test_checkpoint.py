import json
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare.errors import LareError
from lare.training import checkpoint

ROWS = 16


class Held(NamedTuple):
    reward: Any
    next_row: Any


class Learner(NamedTuple):
    replay: Held


def save(directory, buffer, end):
    learner = Learner(Held(jnp.asarray(buffer[None], jnp.float32), jnp.array([end])))
    checkpoint.save(directory, learner, ("reward",), {"step": end}, {})


@settings(max_examples=40, deadline=None)
@given(moves=st.lists(st.integers(-12, 12), min_size=1, max_size=12))
def test_whatever_is_written_and_dropped_the_rows_that_are_held_come_back(moves, tmp_path_factory):
    """Rows are numbered from 1 on as they are written; a move back drops some, whose places are written anew."""
    directory, buffer = tmp_path_factory.mktemp("run") / "checkpoint", np.zeros(ROWS)
    end = furthest = written = 0
    template = Learner(Held(jnp.zeros((1, ROWS)), jnp.zeros(1, int)))
    save(directory, buffer, end)
    for move in moves:
        for _ in range(move):
            written += 1
            buffer[end % ROWS] = written
            end += 1
        furthest = max(furthest, end)
        if move < 0:
            end = max(end + move, 0)
        save(directory, buffer, end)
        found, host, _ = checkpoint.load(directory, template, ("reward",))
        assert host == {"step": end}
        held = np.arange(max(0, furthest - ROWS + 1), end) % ROWS  # the others were written over
        np.testing.assert_array_equal(found.replay.reward[0, held], buffer[held].astype(np.float32))
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
        checkpoint.load(directory, Learner(Held(jnp.zeros((1, ROWS)), jnp.zeros(1, int))), ("reward",))
    assert checkpoint.saved_step(directory) == (None if name == "state.npz" else 3)


def test_a_segment_from_before_a_dropped_episode_outlives_a_newer_one(tmp_path):
    """At 40 of 100 the episode since row 10 was dropped: rows 0 to 40 are of more use for longer than row 10 alone."""
    buffer = np.arange(100.0)
    for end in (0, 40, 10, 60, 125):
        save(tmp_path / "checkpoint", buffer, end)
    found, _, _ = checkpoint.load(
        tmp_path / "checkpoint", Learner(Held(jnp.zeros((1, 100)), jnp.zeros(1, int))), ("reward",)
    )
    np.testing.assert_array_equal(found.replay.reward[0, 25:], buffer[25:].astype(np.float32))


def test_a_bit_that_makes_another_compression_of_it(tmp_path):
    directory = tmp_path / "checkpoint"
    save(directory, np.zeros(ROWS), 3)
    content = bytearray((directory / "state.npz").read_bytes())
    content[content.index(b"PK\x01\x02") + 10] ^= 64
    (directory / "state.npz").write_bytes(content)
    with pytest.raises(LareError, match=r"state\.npz cannot be read: That compression method is not supported"):
        checkpoint.load(directory, Learner(Held(jnp.zeros((1, ROWS)), jnp.zeros(1, int))), ("reward",))


def test_what_a_killed_process_left_makes_room(tmp_path):
    directory = tmp_path / "checkpoint"
    save(directory, np.zeros(ROWS), 3)
    (directory / "rows-1.npz.0123.new").write_bytes(b"half")
    save(directory, np.zeros(ROWS), 5)
    assert {path.name for path in directory.iterdir()} == {"rows-0.npz", "rows-1.npz", "state.npz"}
