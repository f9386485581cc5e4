"""`relabel`: rewards near the true ones where returns show them, and a warning where they do not."""

import json
import math
import signal
import subprocess
import sys

import numpy as np
import pytest

import lare_rl
from helpers.long_tests import long_case
from helpers.toy_logs import PHI, logged_episodes
from lare_rl import LareError
from lare_rl.latent.function import verify_function
from lare_rl.logs.relabel import hold_out_flags
from lare_rl.logs.relabelled import MESSAGES, Relabelled
from lare_rl.util.findings import render


def read(path):
    return [dict(np.load(file)) for file in sorted(path.glob("*.npz"))]


def codes(result):
    return [finding.code for finding in result.findings]


def test_linear_score(folder, tmp_path):
    result = lare_rl.relabel(folder(logged_episodes(120)), tmp_path / "new")
    assert (result.method, result.episodes, result.cut, result.held_out) == ("bayes", 120, 0, 12)
    assert result.return_r2 > 0.98
    assert result.return_correlation > 0.98
    assert codes(result) == ["relabelled", "r2"]
    assert result.summary[2:] == list(result.explanation) != []
    for old, new in zip(logged_episodes(120), read(tmp_path / "new"), strict=True):
        np.testing.assert_array_equal(new["paid"], old["rewards"])
        np.testing.assert_allclose(new["rewards"], old["rewards"], atol=0.5)
        assert all(np.array_equal(new[key], old[key]) for key in ("observations", "actions", "terminations"))


def test_score_of_noise(tmp_path):
    result = lare_rl.relabel(list(logged_episodes(200, noise=True)), tmp_path / "new")
    assert result.return_r2 < 0.1
    assert 0.05 < result.return_r2_error < 1
    assert codes(result) == ["relabelled", "r2", "worthless"]


def test_latent_function(folder, tmp_path, task):
    path = folder(logged_episodes(60))
    phi = verify_function(PHI, task, steps=lare_rl.logged_steps(path, task))
    result = lare_rl.relabel(path, tmp_path / "new", phi=phi, task=task, hold_out=0.2)
    assert (result.method, result.held_out) == ("lare-bayes", 12)
    assert result.return_r2 > 0.95
    assert any("first" in line for line in result.explanation)


def test_cut_episodes_are_not_fitted(folder, tmp_path):
    episodes = list(logged_episodes(60))
    for number in (3, 7, 8):
        episodes[number] |= {"cut": np.array(True), "rewards": np.full_like(episodes[number]["rewards"], 1e6)}
    for number in (20, 21):
        episodes[number] |= {key: np.zeros_like(episodes[number][key]) for key in ("terminations", "truncations")}
    result = lare_rl.relabel(folder(episodes), tmp_path / "new", hold_out=0.2)
    assert result.cut == 5
    assert "cut" in codes(result)
    assert result.return_r2 > 0.95
    assert np.abs(read(tmp_path / "new")[3]["rewards"]).max() < 20


def test_time_limit_of_task(tmp_path, task):
    task = task.model_copy(update={"max_episode_steps": 29})
    result = lare_rl.relabel(list(logged_episodes(80)), tmp_path / "new", task=task)
    lengths = [len(episode["actions"]) for episode in logged_episodes(80) if episode["truncations"].any()]
    assert result.cut == sum(length < 29 for length in lengths) > 0


def test_score_instead_of_rewards(folder, tmp_path):
    def scored():
        for episode in logged_episodes(100):
            score = episode.pop("rewards").sum()
            del episode["terminations"], episode["truncations"]
            yield episode | {"score": score}

    result = lare_rl.relabel(folder(scored()), tmp_path / "new")
    assert result.cut == 0
    assert result.return_r2 > 0.95
    first = read(tmp_path / "new")[0]
    assert first["paid"][-1] == first["score"] == pytest.approx(first["paid"].sum())
    again = lare_rl.relabel(tmp_path / "new", tmp_path / "again")
    assert again.return_r2 == pytest.approx(result.return_r2, abs=1e-6)


def test_relabel_twice_in_place(folder, tmp_path):
    """The second fit is to the original rewards, so that nothing changes."""
    path = folder(logged_episodes(40))
    lare_rl.relabel(path, path, method="rd-linear", overwrite=True)
    first = read(path)
    lare_rl.relabel(path, path, method="rd-linear", overwrite=True)
    for before, after in zip(first, read(path), strict=True):
        assert all(np.array_equal(before[key], after[key]) for key in before)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("method", ["rrdu", long_case("rd"), long_case("diaster"), long_case("rd-linear")])
def test_other_methods(tmp_path, method):
    result = lare_rl.relabel(list(logged_episodes(40)), tmp_path / "new", method=method, updates=16, hold_out=0.25)
    assert math.isfinite(result.return_r2)


def test_flat_arrays_of_d4rl(tmp_path):
    episodes = [
        episode | {"observations": episode["observations"][:-1], "next_observations": episode["observations"][1:]}
        for episode in logged_episodes(50)
    ]
    flat = {key: np.concatenate([episode[key] for episode in episodes]) for key in episodes[0]}
    flat["terminals"], flat["timeouts"] = flat.pop("terminations"), flat.pop("truncations")
    flat["metadata/algorithm"] = np.array("sac")
    flat["timeouts"][-1] = flat["terminals"][-1] = False
    result = lare_rl.relabel(flat, tmp_path / "new", hold_out=0.2)
    assert (result.episodes, result.cut, result.held_out) == (50, 1, 9)
    original_reward = np.concatenate([episode["paid"] for episode in read(tmp_path / "new")])
    np.testing.assert_array_equal(original_reward, flat["rewards"])
    del flat["next_observations"]
    with pytest.raises(LareError, match="next_observations is missing"):
        lare_rl.relabel(flat, tmp_path / "other")


def test_log_is_a_stream(tmp_path):
    """Of 120 long episodes, no more than two batches are alive at a time."""
    n_alive, most_alive = 0, 0

    class CountedEpisode(dict):
        def __init__(self, values):
            nonlocal n_alive, most_alive
            super().__init__(values)
            n_alive += 1
            most_alive = max(most_alive, n_alive)

        def __del__(self):
            nonlocal n_alive
            n_alive -= 1

    class CountedLog:
        def __iter__(self):
            return map(CountedEpisode, logged_episodes(120, max_length=1000))

    result = lare_rl.relabel(CountedLog(), tmp_path / "new", method="rd-linear")
    assert result.episodes == 120
    assert most_alive < 30


def test_hold_out_flags_are_even():
    for share in (0.0, 0.05, 0.1, 0.25, 0.9):
        flags = [flag for flag, _ in zip(hold_out_flags(share, 0), range(1000), strict=False)]
        assert sum(flags) == round(1000 * share)
        assert all(abs(sum(flags[start : start + 100]) - 100 * share) <= 1 for start in range(0, 1000, 100))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"held_out": 1}, ["too_few"]),
        ({"return_correlation": math.nan}, ["constant"]),
        ({"return_r2": math.nan}, ["correlation"]),
        ({"return_r2": 0.09}, ["r2", "worthless"]),
        ({"cut": 3}, ["cut", "r2"]),
    ],
)
def test_findings(changes, expected):
    values = {"episodes": 1, "steps": 1000, "cut": 0, "held_out": 8, "return_r2": 0.9954, "return_r2_error": 0.0004}
    values |= {"out": "new", "method": "rd", "return_correlation": 0.99, "explanation": ("Because.",)}
    result = Relabelled(**(values | changes))
    assert codes(result) == ["relabelled", *expected]
    assert result.summary == [*(render(finding, MESSAGES) for finding in result.findings), "Because."]
    assert "1,000 steps" in result.summary[0]
    assert "1 episode." in result.summary[0]


def test_failure_writes_nothing(folder, tmp_path):
    path = folder(logged_episodes(20))
    (path / "0019.npz").write_bytes(b"not an archive")
    with pytest.raises(LareError, match=r"0019\.npz is not an \.npz file"):
        lare_rl.relabel(path, tmp_path / "new")
    assert list(tmp_path.iterdir()) == [path]


def test_failure_in_second_pass_keeps_old_output(tmp_path):
    class ChangingLog:
        passes = 0

        def __iter__(self):
            self.passes += 1
            return iter(logged_episodes(20 if self.passes < 4 else 19))

    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "mine.npz").write_text("kept")
    with pytest.raises(LareError, match="changed while it was read: it had 20 episodes, and now 19"):
        lare_rl.relabel(ChangingLog(), tmp_path / "new", overwrite=True)
    assert [path.name for path in tmp_path.rglob("*")] == ["new", "mine.npz"]
    assert (tmp_path / "new" / "mine.npz").read_text() == "kept"


def test_directory_of_other_files_is_not_replaced(folder, tmp_path):
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("years")
    with pytest.raises(LareError, match=r"precious .*thesis\.txt"):
        lare_rl.relabel(folder(logged_episodes(9)), tmp_path / "precious", method="rd-linear", overwrite=True)
    assert (tmp_path / "precious" / "thesis.txt").read_text() == "years"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "ircr"}, "ircr gives all steps"),
        ({"method": "dense"}, "dense assigns no credit"),
        ({"method": "lare-bayes"}, "lare-bayes needs a phi"),
        ({"hold_out": 1.0}, "hold_out = 1.0"),
        ({"hold_out": math.nan}, "hold_out = nan"),
        ({"memory": 0.0}, "memory = 0.0"),
        ({"updates": 0}, "updates = 0"),
    ],
)
def test_bad_options(tmp_path, options, message):
    with pytest.raises(LareError, match=message):
        lare_rl.relabel(list(logged_episodes(10)), tmp_path / "new", **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("log", "message"),
    [
        ([episode | {"cut": True} for episode in logged_episodes(3)], "none of 3 episodes"),
        ([], "no episode"),
        ([7], "episode 0 must be a mapping"),
        (logged_episodes(3), "read twice"),
    ],
)
def test_bad_list(tmp_path, log, message):
    with pytest.raises(LareError, match=message):
        lare_rl.relabel(log, tmp_path / "new")


def test_command(command, folder, tmp_path, task):
    path = folder(logged_episodes(40))
    keys = ("name", "environment", "observation_size", "action_size", "description", "observation", "action")
    (tmp_path / "task.toml").write_text("".join(f"{key} = {json.dumps(getattr(task, key))}\n" for key in keys))
    (tmp_path / "phi.py").write_text(PHI)
    options = ("--task", "task.toml", "--function", "phi.py", "--hold-out", "0.2")
    status, out, error = command("relabel", path, "--out", "new", *options)
    assert (status, error) == (0, "learning, 40 episodes\nwriting, 40 episodes\n")
    assert "lare-bayes" in out.splitlines()[0]
    assert out.splitlines()[-1] == "wrote new"
    status, out, error = command("relabel", path, "--out", "new")
    assert (status, out) == (2, "")
    assert "new exists" in error
    status, out, _ = command("verify", "phi.py", "--task", "task.toml", "--data", path)
    assert (status, "FAILED" in out) == (0, False)
    for arguments in (("verify", "phi.py", "--task", "task.toml"), ("train", "task.toml")):
        status, _, error = command(*arguments)
        assert status != 0
        assert "task 'Logs' has no environment" in error
    assert "gone/ does not exist" in command("relabel", "gone/", "--out", "new2")[2]


def test_terminated_command_leaves_nothing(folder, tmp_path):
    path = folder(logged_episodes(3000))
    command = [sys.executable, "-c", "from lare_rl.cli import main; main()", "relabel", str(path), "--out", "new"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        while not process.stderr.readline().startswith("writing"):
            assert process.poll() is None
        process.terminate()
    assert process.returncode == 128 + signal.SIGTERM
    assert [file.name for file in tmp_path.iterdir() if "new" in file.name] == []
