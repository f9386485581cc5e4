"""Rewards for logs: near what was paid where the score says so, and said to be worth nothing where it does not."""

import json
import math
import signal
import subprocess
import sys

import numpy as np
import pytest

import lare_rl
from helpers.logged import PHI, logged
from helpers.tiers import long
from lare_rl import LareError
from lare_rl.latent.function import verified
from lare_rl.logs import relabel as module
from lare_rl.logs.relabel import held


def read(path):
    return [dict(np.load(file)) for file in sorted(path.glob("*.npz"))]


def test_a_linear_score_is_found_and_told_from_unseen_returns(folder, tmp_path):
    found = lare_rl.relabel(folder(logged(120)), tmp_path / "new")
    assert (found.method, found.episodes, found.cut, found.held_out) == ("bayes", 120, 0, 12)
    assert found.return_r2 > 0.98
    assert any("Raw entries explain" in line for line in found.explanation)
    assert found.words[1] == (
        f"The returns of 12 episodes held out, which nothing was fitted to, are predicted with an R² of {found.return_r2:.3f}, "
        "with a standard error of less than 0.001."
    )
    for old, new in zip(logged(120), read(tmp_path / "new"), strict=True):
        np.testing.assert_array_equal(new["paid"], old["rewards"])
        np.testing.assert_allclose(new["rewards"], old["rewards"], atol=0.5)
        assert all(np.array_equal(new[key], old[key]) for key in ("observations", "actions", "terminations"))


def test_a_score_of_noise_is_said_to_be_noise(tmp_path):
    found = lare_rl.relabel(list(logged(200, noise=True)), tmp_path / "new")
    assert found.return_r2 < 0.2
    assert f"with a standard error of {found.return_r2_error:.1g}." in found.words[1]
    assert 0.05 < found.return_r2_error < 1
    assert any(line.startswith("Warning: that is no better than their mean.") for line in found.words)


def test_a_function_is_verified_on_logs_and_used(folder, tmp_path, task):
    path = folder(logged(60))
    phi = verified(PHI, task, steps=lare_rl.logged_steps(path, task))
    found = lare_rl.relabel(path, tmp_path / "new", phi=phi, task=task, hold_out=0.2)
    assert (found.method, found.held_out) == ("lare-bayes", 12)
    assert found.return_r2 > 0.95
    assert any("first" in line for line in found.explanation)


def test_cut_episodes_are_paid_and_not_learned_from(folder, tmp_path):
    episodes = list(logged(60))
    for number in (3, 7, 8):
        episodes[number] |= {"cut": np.array(True), "rewards": np.full_like(episodes[number]["rewards"], 1e6)}
    for number in (20, 21):
        episodes[number] |= {key: np.zeros_like(episodes[number][key]) for key in ("terminations", "truncations")}
    found = lare_rl.relabel(folder(episodes), tmp_path / "new", hold_out=0.2)
    assert found.cut == 5
    assert found.return_r2 > 0.95
    assert "Cut before their end, and not learned from: 5 episodes." in found.words
    assert np.abs(read(tmp_path / "new")[3]["rewards"]).max() < 20


def test_the_time_limit_says_what_was_cut(tmp_path, task):
    limited = task.model_copy(update={"max_episode_steps": 29})
    found = lare_rl.relabel(list(logged(80)), tmp_path / "new", task=limited)
    truncated = [len(one["actions"]) for one in logged(80) if one["truncations"].any()]
    assert found.cut == sum(steps < 29 for steps in truncated) > 0


def test_one_score_stands_for_rewards(folder, tmp_path):
    def scored():
        for values in logged(100):
            score = values.pop("rewards").sum()
            del values["terminations"], values["truncations"]
            yield values | {"score": score}

    found = lare_rl.relabel(folder(scored()), tmp_path / "new")
    assert (found.cut, found.return_r2 > 0.95) == (0, True)
    first = read(tmp_path / "new")[0]
    assert first["paid"][-1] == first["score"] == pytest.approx(first["paid"].sum())
    again = lare_rl.relabel(tmp_path / "new", tmp_path / "again")
    assert again.return_r2 == pytest.approx(found.return_r2, abs=1e-6)


def test_what_was_relabelled_can_be_relabelled(folder, tmp_path):
    """By what was paid at first, not by what the rewards are now; in its own place, too, where that is asked for."""
    path = folder(logged(40))
    lare_rl.relabel(path, path, method="rd-linear", overwrite=True)
    once = read(path)
    lare_rl.relabel(path, path, method="rd-linear", overwrite=True)
    for before, after in zip(once, read(path), strict=True):
        assert all(np.array_equal(before[key], after[key]) for key in before)
    assert [one.name for one in tmp_path.iterdir()] == ["log"]


@pytest.mark.parametrize("method", ["rrdu", long("rd"), long("diaster"), long("rd-linear")])
def test_other_methods_too(tmp_path, method):
    found = lare_rl.relabel(list(logged(40)), tmp_path / "new", method=method, updates=16, hold_out=0.25)
    assert math.isfinite(found.return_r2)


def test_flat_arrays_as_d4rl_has_them(tmp_path):
    parts = [one | {"next_observations": one["observations"][1:]} for one in logged(50)]
    for one in parts:
        one["observations"] = one["observations"][:-1]
    flat = {key: np.concatenate([one[key] for one in parts]) for key in parts[0]}
    flat["terminals"], flat["timeouts"] = flat.pop("terminations"), flat.pop("truncations")
    flat["metadata/algorithm"] = np.array("sac")
    flat["timeouts"][-1] = flat["terminals"][-1] = False  # the last one goes on
    found = lare_rl.relabel(flat, tmp_path / "new", hold_out=0.2)
    assert (found.episodes, found.cut, found.held_out) == (50, 1, 9)
    again = read(tmp_path / "new")
    np.testing.assert_array_equal(np.concatenate([one["paid"] for one in again]), flat["rewards"])


def test_a_log_is_read_as_a_stream(tmp_path, monkeypatch):
    """Episodes are gone soon after they were read: no more of them are alive than fit into a few pieces."""
    monkeypatch.setattr(module, "PIECE", 64)
    alive, most = [0], [0]

    class Told(dict):
        def __init__(self, values):
            super().__init__(values)
            alive[0] += 1
            most[0] = max(most[0], alive[0])

        def __del__(self):
            alive[0] -= 1

    class Log:
        def __iter__(self):
            return map(Told, logged(300))

    found = lare_rl.relabel(Log(), tmp_path / "new", method="rd-linear")
    assert found.episodes == 300
    assert most[0] < 20


def test_fair_shares_are_held_out():
    for share in (0.0, 0.05, 0.1, 0.25, 0.9):
        chosen = [out for out, _ in zip(held(share, 0), range(1000), strict=False)]
        assert sum(chosen) == round(1000 * share)
        assert all(abs(sum(chosen[start : start + 100]) - 100 * share) <= 1 for start in range(0, 1000, 100))


def test_an_output_is_whole_or_not_there(folder, tmp_path):
    path = folder(logged(20))
    (path / "0019.npz").write_bytes(b"not an archive")
    with pytest.raises(LareError, match=r"0019\.npz is no \.npz file, or a damaged one: [^\n]+\Z"):
        lare_rl.relabel(path, tmp_path / "new")
    assert [one.name for one in tmp_path.iterdir()] == ["log"]


def test_a_failure_in_the_second_pass_leaves_what_was_there(tmp_path):
    """The log changes while it is read: nothing is written, and what was at the place is as it was."""

    class Log:
        passes = 0

        def __iter__(self):
            self.passes += 1
            return iter(logged(20 if self.passes < 4 else 19))

    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "mine.npz").write_text("kept")
    with pytest.raises(LareError) as error:
        lare_rl.relabel(Log(), tmp_path / "new", overwrite=True)
    assert str(error.value) == "episodes has changed while it was read: 20 episodes first, then 19"
    assert [one.name for one in tmp_path.iterdir()] == ["new"]
    assert (tmp_path / "new" / "mine.npz").read_text() == "kept"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "ircr"}, "ircr pays all steps of an episode alike, by its return: a log needs no decoder for that"),
        ({"method": "dense"}, "dense assigns no credit: train on what the environment pays"),
        ({"method": "lare-bayes"}, "lare-bayes needs a phi; bayes, rd and rrdu need none"),
        ({"hold_out": 1.0}, "hold_out = 1.0: a share from 0 to 0.9"),
        ({"hold_out": math.nan}, "hold_out = nan: a share from 0 to 0.9"),
        ({"memory": 0.0}, "memory = 0.0 and updates = 10000 must be more than 0"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path, options, message):
    with pytest.raises(LareError) as error:
        lare_rl.relabel(list(logged(10)), tmp_path / "new", **options)
    assert (str(error.value), list(tmp_path.iterdir())) == (message, [])


def test_nothing_whole_is_nothing_to_learn_from(tmp_path):
    cut = [one | {"cut": True} for one in logged(3)]
    with pytest.raises(LareError) as error:
        lare_rl.relabel(cut, tmp_path / "new")
    assert str(error.value).startswith("episodes: none of 3 episodes is whole and not held out")


def test_the_command(command, folder, tmp_path, task):
    path = folder(logged(40))
    keys = ("name", "environment", "observation_size", "action_size", "description", "observation", "action")
    (tmp_path / "task.toml").write_text("".join(f"{key} = {json.dumps(getattr(task, key))}\n" for key in keys))
    (tmp_path / "phi.py").write_text(PHI)
    options = ("--task", "task.toml", "--function", "phi.py", "--hold-out", "0.2")
    status, said, wrong = command("relabel", path, "--out", "new", *options)
    assert (status, wrong) == (0, "learning, 40 episodes\nwriting, 40 episodes\n")
    assert "lare-bayes" in said.splitlines()[0]
    assert said.splitlines()[-1] == "wrote new"
    assert command("relabel", path, "--out", "new") == (
        2,
        "",
        "lare-rl: new exists: choose another directory, or replace it with --overwrite (overwrite=True)\n",
    )
    status, said, _ = command("verify", "phi.py", "--task", "task.toml", "--data", path)
    assert (status, "FAILED" in said) == (0, False)
    assert command("verify", "phi.py", "--task", "task.toml")[2].startswith("lare-rl: task 'Logs' has no environment")
    status, _, wrong = command("train", "task.toml")
    assert (status, wrong.count("\n")) == (2, 1)
    assert wrong.startswith("lare-rl: task 'Logs' has no environment (environment = 'none')")
    assert command("relabel", "gone/", "--out", "new2")[2] == "lare-rl: there is no gone/\n"


def test_a_directory_of_other_files_is_never_replaced(folder, tmp_path):
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("years")
    with pytest.raises(LareError) as refused:
        lare_rl.relabel(folder(logged(9)), tmp_path / "precious", method="rd-linear", overwrite=True)
    assert str(refused.value) == (
        f"{tmp_path / 'precious'} holds thesis.txt, which is not a log, and is not replaced: choose another directory"
    )
    assert (tmp_path / "precious" / "thesis.txt").read_text() == "years"


def test_one_that_is_asked_to_end_leaves_nothing_behind(folder, tmp_path):
    path = folder(logged(3000))
    command = [sys.executable, "-c", "from lare_rl.cli import main; main()", "relabel", str(path), "--out", "new"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as running:
        while not running.stderr.readline().startswith("writing"):
            assert running.poll() is None
        running.terminate()
    assert running.returncode == 128 + signal.SIGTERM
    assert [one.name for one in tmp_path.iterdir() if "new" in one.name] == []
