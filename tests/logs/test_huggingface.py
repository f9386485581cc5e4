"""Hugging Face data sets on the disk."""

import datasets
import numpy as np
import pytest

import lare_rl
from helpers.logged import logged
from lare_rl import LareError
from lare_rl.logs import tables
from lare_rl.logs.source import open_logs


@pytest.fixture(autouse=True)
def quiet():
    datasets.disable_progress_bars()
    yield
    datasets.enable_progress_bars()


def of_steps(episodes):
    """A row for each step."""
    rows = []
    for number, one in enumerate(episodes):
        for step in range(len(one["actions"])):
            row = {key: one[key][step].tolist() for key in ("actions", "rewards", "terminations", "truncations")}
            shown = one["observations"][step : step + 2].tolist()
            rows.append({"episode": number, "observations": shown[0], "next_observations": shown[1], **row})
    return datasets.Dataset.from_list(rows)


def of_episodes(episodes):
    """A row for each episode, with arrays of fixed width."""
    keys = ("observations", "actions", "rewards")
    return datasets.Dataset.from_list([{key: one[key].tolist() for key in keys} for one in episodes])


@pytest.mark.parametrize("table", [of_steps, of_episodes])
def test_round_trip(table, tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "ROWS", 50)
    path, out = tmp_path / "log", tmp_path / "new"
    table(logged(40)).save_to_disk(path, num_shards=2)
    for one, wanted in zip(open_logs(path).episodes(), logged(40), strict=True):
        np.testing.assert_allclose(one.before, wanted["observations"][:-1])
        np.testing.assert_allclose(one.after, wanted["observations"][1:])
        np.testing.assert_allclose(one.paid, wanted["rewards"])
    found = lare_rl.relabel(path, out, hold_out=0.2)
    assert found.return_r2 > 0.9
    old, new = datasets.load_from_disk(path), datasets.load_from_disk(out)
    assert new.column_names == [*old.column_names, "paid"]
    same = [name for name in old.column_names if name != "rewards"]
    assert new.select_columns(same).to_list() == old.select_columns(same).to_list()
    assert new["paid"][:] == old["rewards"][:]
    assert sorted(file.suffix for file in out.iterdir()) == [".arrow", ".json", ".json"]
    for one, wanted in zip(open_logs(out).episodes(), logged(40), strict=True):
        np.testing.assert_allclose(one.paid, wanted["rewards"])


def test_arrays_of_fixed_shape(tmp_path):
    one = next(iter(logged(1)))
    steps = len(one["actions"])
    features = datasets.Features(
        {
            "observations": datasets.Array2D((steps + 1, 2), "float32"),
            "actions": datasets.Array2D((steps, 1), "float32"),
            "rewards": datasets.Sequence(datasets.Value("float32")),
        }
    )
    rows = {key: [one[key]] for key in features}
    datasets.Dataset.from_dict(rows, features=features).save_to_disk(tmp_path / "log")
    (found,) = open_logs(tmp_path / "log").episodes()
    np.testing.assert_array_equal(found.before, one["observations"][:-1])
    np.testing.assert_array_equal(found.action, one["actions"])


def test_one_of_several_splits_must_be_named(tmp_path):
    whole = datasets.DatasetDict({"train": of_episodes(logged(3)), "test": of_episodes(logged(2))})
    whole.save_to_disk(tmp_path / "log")
    with pytest.raises(LareError) as error:
        open_logs(tmp_path / "log")
    path = tmp_path / "log"
    assert str(error.value) == f"{path} holds several data sets: name one of {path / 'test'}, {path / 'train'}"
    assert len(list(open_logs(path / "test").episodes())) == 2


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: (path / "state.json").write_text("{"),
        lambda path: (path / "state.json").write_text("[]"),
        lambda path: (path / "dataset_info.json").unlink(),
        lambda path: next(path.glob("*.arrow")).unlink(),
        lambda path: next(path.glob("*.arrow")).write_bytes(b"ARROW"),
    ],
)
def test_a_damaged_one_is_refused(damage, tmp_path):
    of_episodes(logged(3)).save_to_disk(tmp_path / "log")
    damage(tmp_path / "log")
    with pytest.raises(LareError, match=r"log is no Hugging Face data set, or a damaged one: [^\n]+\Z"):
        open_logs(tmp_path / "log")
