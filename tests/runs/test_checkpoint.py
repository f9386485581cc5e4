"""Checkpoints: rows that come back, files of killed processes, and damaged files."""

import json
import re
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.small_configs import small_config
from lare_rl.errors import LareError
from lare_rl.nn import normalise
from lare_rl.runs import checkpoint
from lare_rl.runs.best_policy import empty_best, save_best, update_best
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule
from lare_rl.training.compiled import learner_shape

CAPACITY = 16


class Replay(NamedTuple):
    columns: Any
    row: Any
    next_row: Any


class Learner(NamedTuple):
    replay: Replay


def template(*shape):
    return Learner(Replay({"reward": jnp.zeros(shape)}, jnp.zeros(shape, int), jnp.zeros(shape[:-1], int)))


def save(directory, rows, end):
    """Save the replay of one seed, of one or several environments."""
    rows, end = np.atleast_2d(rows), np.atleast_1d(end)
    row = jnp.broadcast_to(jnp.arange(rows.shape[1]), (1, *rows.shape))
    learner = Learner(Replay({"reward": jnp.asarray(rows[None], jnp.float32)}, row, jnp.asarray(end[None])))
    checkpoint.write(directory, checkpoint.take_snapshot(directory, learner, {"step": int(end.sum())}, {}))


@settings(max_examples=12, deadline=None)
@given(moves=st.lists(st.tuples(st.integers(-12, 12), st.integers(-12, 12)), min_size=1, max_size=12))
def test_rows_come_back(moves, tmp_path_factory):
    """A move forward writes rows in an environment. A move back drops some, which are overwritten later."""
    directory, rows = tmp_path_factory.mktemp("run") / "checkpoint", np.zeros((2, CAPACITY))
    end, furthest, n_written = np.zeros(2, int), np.zeros(2, int), 0
    save(directory, rows, end)
    for move in moves:
        for env in (0, 1):
            for _ in range(move[env]):
                n_written += 1
                rows[env, end[env] % CAPACITY] = n_written
                end[env] += 1
            furthest[env] = max(furthest[env], end[env])
            if move[env] < 0:
                end[env] = max(end[env] + move[env], 0)
            rows[env, end[env] % CAPACITY] = -n_written  # the newest observation, before its step is complete
        save(directory, rows, end)
        learner, host, _ = checkpoint.load(directory, template(1, 2, CAPACITY))
        assert host == {"step": end.sum()}
        np.testing.assert_array_equal(learner.replay.next_row, [end])
        for env in (0, 1):
            valid = np.arange(max(0, furthest[env] - CAPACITY + 1), end[env] + 1) % CAPACITY
            expected = rows[env, valid].astype(np.float32)
            np.testing.assert_array_equal(learner.replay.columns["reward"][0, env, valid], expected)
        with np.load(directory / "state.npz") as state:
            in_use = {f"rows-{segment['number']}.npz" for segment in json.loads(str(state["segments"]))}
        assert {path.name for path in directory.iterdir()} == in_use | {"state.npz"}


OLD_NAMES = {"next_transition": "transitions", "current_episode": "episodes", "n_effective": "n_determined"}


@pytest.mark.parametrize(("method", "payments"), [("bayes", PaymentRule(period=4)), ("ircr", PAID_AT_END)])
def test_learner_comes_back(method, payments, tmp_path):
    """Also from an earlier version. No field has the old name of another, so none is renamed when it is read."""
    config = small_config(method, payments=payments)
    config = replace(config, credit=config.credit.model_copy(update={"exact": "last" if method == "bayes" else "no"}))
    shape = learner_shape(config, 1)
    leaves, structure = jax.tree.flatten(shape)
    learner = jax.tree.unflatten(structure, [np.full(leaf.shape, n, leaf.dtype) for n, leaf in enumerate(leaves)])
    expected = checkpoint.named_leaves(learner)
    checkpoint.write(tmp_path, checkpoint.take_snapshot(tmp_path, learner, {"step": 0}, {}))
    jax.tree.map(np.testing.assert_array_equal, checkpoint.named_leaves(checkpoint.load(tmp_path, shape)[0]), expected)
    with np.load(tmp_path / "state.npz") as saved:
        arrays = {re.sub(r"(?<=\.)\w+", lambda m: OLD_NAMES.get(m[0], m[0]), name): saved[name] for name in saved.files}
    if method == "ircr":  # it had only a scale
        names = [name for name in arrays if ".decoders[" not in name or "[0].scale." in name]
        arrays = {name.replace(".decoders[0].scale.", ".scale[0]."): arrays[name] for name in names}
        expected = {name: values for name, values in expected.items() if name in names}
    np.savez(tmp_path / "state.npz", **arrays)
    loaded = checkpoint.named_leaves(checkpoint.load(tmp_path, shape)[0])
    jax.tree.map(np.testing.assert_array_equal, {name: loaded[name] for name in expected}, expected)


def test_files_of_killed_process_and_best_policies(tmp_path):
    directory = tmp_path / "checkpoint"
    save(directory, np.zeros(CAPACITY), 3)
    for name in ("rows-1.npz.0123.new", "rows-7.npz", "best.npz.0123.new"):
        (directory / name).write_bytes(b"half")
    save(directory, np.zeros(CAPACITY), 5)
    # The last name may be a file that is being written just now.
    expected = {"rows-0.npz", "rows-1.npz", "state.npz", "best.npz.0123.new"}
    assert {path.name for path in directory.iterdir()} == expected
    save_best(directory, update_best(empty_best(1), np.ones(1), 5, np.zeros((1, 2))))
    assert {path.name for path in directory.glob("best*")} == {"best.npz"}
    with pytest.raises(LareError, match=r"state\.npz/checkpoint cannot be written"):
        save(directory / "state.npz" / "checkpoint", np.zeros(CAPACITY), 3)
    best = empty_best(2)  # NaN is never the best evaluation, and equal ones are not better
    for step, returns in ((1, [np.nan, -3.0]), (2, [-5.0, np.nan]), (3, [-5.0, -4.0])):
        best = update_best(best, np.array(returns), step, np.full((2, 1), step))
    assert [array.tolist() for array in best] == [[-5.0, -3.0], [2, 1], [[2], [1]]]


def test_row_files_of_dropped_episodes(tmp_path):
    """Rows that are dropped at once are not written."""
    save(tmp_path / "checkpoint", np.arange(16.0), 3)
    save(tmp_path / "checkpoint", np.arange(16.0), 5000)
    with np.load(tmp_path / "checkpoint" / "rows-1.npz") as rows:
        assert rows["reward"].shape == (1, 1, CAPACITY)
    learner, _, _ = checkpoint.load(tmp_path / "checkpoint", template(1, 1, CAPACITY))
    np.testing.assert_array_equal(learner.replay.columns["reward"][0, 0], np.arange(16))
    # At row 40 of 100, the episode since row 10 is dropped: rows 0 to 40 are used for longer than row 10 alone.
    rows = np.arange(100.0)
    for end in (0, 40, 10, 60, 125):
        save(tmp_path / "longer", rows, end)
    learner, _, _ = checkpoint.load(tmp_path / "longer", template(1, 1, 100))
    np.testing.assert_array_equal(learner.replay.columns["reward"][0, 0, 25:], rows[25:].astype(np.float32))


@pytest.mark.parametrize(("name", "metadata"), [("state.npz", None), ("rows-0.npz", {"step": 3})])
def test_truncated_file_is_refused(name, metadata, tmp_path):
    save(tmp_path, np.zeros(CAPACITY), 3)
    content = (tmp_path / name).read_bytes()
    for n_bytes in (1, 100, 200):
        (tmp_path / name).write_bytes(content[:n_bytes])
        with pytest.raises(LareError, match=r"state\.npz cannot be read"):
            checkpoint.load(tmp_path, template(1, 1, CAPACITY))
        assert checkpoint.read_metadata(tmp_path) == metadata


def test_larger_replay_and_missing_arrays(tmp_path):
    save(tmp_path / "checkpoint", np.arange(1.0, CAPACITY + 1), 9)
    with pytest.raises(LareError, match=r"\.replay\.row has shape \(1, 1, 16\), not \(1, 1, 12\)"):
        checkpoint.load(tmp_path / "checkpoint", template(1, 1, CAPACITY - 4))
    learner, _, _ = checkpoint.load(tmp_path / "checkpoint", template(1, 1, CAPACITY + 4))
    np.testing.assert_array_equal(learner.replay.columns["reward"][0, 0], [*range(1, 11), *[0] * 10])
    np.testing.assert_array_equal(learner.replay.row[0, 0], [*range(CAPACITY), *[0] * 4])

    class Closed(NamedTuple):
        strengths: Any
        weight: Any
        before_end: Any = ()

    class State(NamedTuple):
        closed_form: Closed

    before_end = normalise.empty_mean_std(2)
    state = State(Closed(Closed(jnp.ones(1), jnp.ones(3)), jnp.ones(2), before_end))
    filled = checkpoint.fill_template(state, {".closed_form.weight": np.full(2, 5.0, np.float32)})
    assert filled.closed_form.weight.tolist() == [5, 5]
    assert filled.closed_form.strengths.weight.tolist() == [0, 0, 0]
    assert all(normalise.running_std(filled.closed_form.before_end) > 0)  # no input is terminal
    with pytest.raises(ValueError, match="weight is missing"):
        checkpoint.fill_template(state, {})

    class Fitted(NamedTuple):
        statistics: Closed

    fitted = Fitted(Closed(jnp.ones(1), jnp.ones(2)))  # a method that fits nothing had no statistics
    assert checkpoint.fill_template(fitted, {}).statistics.weight.tolist() == [0, 0]
    with pytest.raises(ValueError, match="weight is missing"):
        checkpoint.fill_template(fitted, {".statistics.strengths": np.ones(1, np.float32)})
