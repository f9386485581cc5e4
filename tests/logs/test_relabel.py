"""`relabel`: rewards near the true ones where returns show them, and a warning where they do not."""

import io
import json
import math
import signal
import sys
from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import lare_rl
from helpers.long_tests import long_case
from helpers.toy_envs import toy_spec
from helpers.toy_logs import PHI, logged_episodes, read_directory
from lare_rl import LareError
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.logs import log as log_module
from lare_rl.logs.relabel import MESSAGES, Relabelled, _r2_within_groups, hold_out_flags
from lare_rl.tasks.spec import PaidSteps
from lare_rl.util.findings import render

SUM = CreditSettings(score="sum")
relabel = partial(lare_rl.relabel, memory=0.01)


def codes(result):
    return [finding.code for finding in result.findings]


@pytest.mark.long
def test_linear_score(folder, tmp_path):
    """Nothing is learned from episodes that were cut. They get rewards too."""
    episodes = list(logged_episodes(120))
    for number in (3, 7, 8):
        episodes[number] |= {"cut": np.array(True), "rewards": np.full_like(episodes[number]["rewards"], 1e6)}
    for number in (20, 21):
        episodes[number] |= {key: np.zeros_like(episodes[number][key]) for key in ("terminations", "truncations")}
    stages = []
    result = relabel(folder(episodes), tmp_path / "new", settings=SUM, listener=lambda *stage: stages.append(stage))
    assert stages == [(stage, n, 120) for stage in ("fit", "write") for n in range(1, 121)]
    assert (result.method, result.out, result.episodes, result.cut) == ("bayes", tmp_path / "new", 120, 5)
    assert (result.held_out, result.steps) == (11, sum(len(episode["actions"]) for episode in episodes))
    assert result.return_r2 > 0.98
    assert result.return_correlation > 0.98
    assert codes(result) == ["relabelled", "cut", "r2"]
    assert result.summary[3:] == list(result.explanation) != []
    for episode, old, new in zip(logged_episodes(120), episodes, read_directory(tmp_path / "new"), strict=True):
        np.testing.assert_array_equal(new["paid"], old["rewards"])
        np.testing.assert_allclose(new["rewards"], episode["rewards"], atol=0.5)
        assert all(np.array_equal(new[key], old[key]) for key in ("observations", "actions", "terminations"))


@pytest.mark.long
def test_groups_share_an_intercept(tmp_path):
    """Returns of the group "hard" are lower, and so is the second entry, which no step is paid for."""
    rows = []
    for number, episode in enumerate(logged_episodes(120)):
        shift = 2 * (number % 2) - 1
        episode["observations"] = episode["observations"] + np.float32([0, shift])
        score = episode.pop("rewards").sum() + 5 * len(episode["actions"]) * shift
        arrays = {key: value.tolist() for key, value in episode.items()}
        rows.append(arrays | {"score": score, "group": "easy" if number % 2 else "hard"})
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "log.parquet")
    result = relabel(tmp_path / "log.parquet", tmp_path / "new.parquet", settings=SUM)
    assert result.return_r2 > 0.98
    new = pq.read_table(tmp_path / "new.parquet").to_pylist()
    means = [np.mean([np.mean(e["rewards"]) for e in new if e["group"] == name]) for name in ("easy", "hard")]
    assert abs(means[0] - means[1]) < 1.5  # without groups: about 10


@pytest.mark.long
def test_predicted_returns_have_the_part_that_no_step_is_paid_for(tmp_path):
    episodes = list(logged_episodes(80, max_length=8))
    for episode in episodes:
        episode["score"] = np.array(100 + episode.pop("rewards").sum())
    assert relabel(episodes, tmp_path / "new", method="bayes-progress", settings=SUM, hold_out=0.2).return_r2 > 0.3


def paid_every_4(episodes, window, mean=False):
    """Return episodes that pay for the last `window` steps every 4 steps and at the end, and their rewards in the unit of payments."""
    rewards = []
    for episode in episodes:
        n_steps, payments = len(episode["rewards"]), np.zeros_like(episode["rewards"])
        rewards.append(episode["rewards"].copy())
        for end in payment_ends(n_steps):
            steps = slice(max(0, end - window), end)
            payments[end - 1] = episode["rewards"][steps].mean() if mean else episode["rewards"][steps].sum()
            if mean:
                rewards[-1][max(0, (end - 1) // 4 * 4) : end] /= min(end, window)
        episode["rewards"] = payments
    return episodes, rewards


def payment_ends(n_steps):
    return [*range(4, n_steps, 4), n_steps]


def new_rewards(path):
    return [episode["rewards"] for episode in read_directory(path)]


@pytest.mark.parametrize(("window", "score", "exact"), [(2, "sum", "last"), long_case(8, "average", "no")])
def test_payments_for_a_fixed_number_of_steps(window, score, exact, task, tmp_path):
    """Steps are in no payment, or in two. What each payment lacks is 0, so that `exact` changes nothing."""
    episodes, rewards = paid_every_4(list(logged_episodes(80)), window, mean=score == "average")
    task = task.model_copy(update={"payments": 4, "paid_for": PaidSteps(steps=window), "score": score})
    result = relabel(episodes, tmp_path / "new", task=task, hold_out=0.2, settings=CreditSettings(exact=exact))
    assert result.return_r2 > 0.999
    unpaid = []
    for new, expected in zip(new_rewards(tmp_path / "new"), rewards, strict=True):
        ends = np.minimum(np.arange(len(new)) // 4 * 4 + 4, len(new))
        unpaid.append((new - expected) * np.minimum(ends, window))
    assert np.ptp(np.concatenate(unpaid)) < 0.05  # no step is paid for the mean of averages
    assert score == "average" or np.abs(unpaid[0]).max() < 0.05


@pytest.mark.parametrize(("exact", "window"), [long_case("last", 8), ("spread", None)])
def test_exact_pays_what_each_payment_lacks(exact, window, task, tmp_path):
    """The steps that a payment is for then add up to it, if no other payment is for them."""
    episodes, _ = paid_every_4([e for e in logged_episodes(60, noise=True) if len(e["actions"]) % 4 != 1], window or 4)
    update = {"payments": 4, "score": "sum"} | ({"paid_for": PaidSteps(steps=window)} if window else {})
    task = task.model_copy(update=update)
    for name in (exact, "no"):
        relabel(episodes, tmp_path / name, task=task, settings=CreditSettings(exact=name))
    files = new_rewards(tmp_path / exact), new_rewards(tmp_path / "no")
    for episode, new, fitted in zip(episodes, *files, strict=True):
        expected = fitted.astype(np.float64)
        ends = payment_ends(len(new))
        for begin, end in zip([0, *ends], ends, strict=False):
            steps = slice(max(0, end - window) if window else begin, end)
            lacks = episode["rewards"][end - 1] - fitted[steps].sum()
            expected[end - 1 if exact == "last" else steps] += lacks / (1 if exact == "last" else end - begin)
            if window != 8:
                assert new[steps].sum() == pytest.approx(episode["rewards"][end - 1], abs=1e-4)
        np.testing.assert_allclose(new, expected, atol=1e-4)
        assert np.abs(new - fitted).max() > 0.1


def test_score_is_paid_at_the_end(task, tmp_path):
    """Whatever the payments of the task are, also when the log is relabelled again."""
    episodes = list(logged_episodes(80))
    rewards = [episode.pop("rewards") for episode in episodes]
    for episode, values in zip(episodes, rewards, strict=True):
        episode["score"] = values.sum()
    task = task.model_copy(update={"payments": 4, "paid_for": PaidSteps(steps=8)})
    for source in (episodes, tmp_path / "new"):
        result = relabel(source, tmp_path / "new", task=task, settings=SUM, hold_out=0.2, overwrite=True)
        assert result.return_r2 > 0.999
        for new, expected in zip(new_rewards(tmp_path / "new"), rewards, strict=True):
            np.testing.assert_allclose(new, expected, atol=0.05)
    with pytest.raises(LareError, match="several: use exact = 'last'"):
        relabel(episodes, tmp_path / "other", task=task, settings=CreditSettings(exact="spread"))


def test_score_of_noise(tmp_path):
    result = relabel(list(logged_episodes(120, noise=True)), tmp_path / "new", settings=SUM)
    assert result.return_r2 < 0.1
    assert 0.05 < result.return_r2_error < 1
    assert codes(result) == ["relabelled", "r2", "worthless"]


@pytest.mark.long
def test_relabel_twice_in_place(folder, tmp_path):
    """The second fit is to the original rewards, so that nothing changes."""
    path = folder(logged_episodes(40))
    options = {"method": "rrdu", "updates": 16, "hold_out": 0.25, "overwrite": True, "settings": SUM}
    assert math.isfinite(relabel(path, path, **options).return_r2)
    first = read_directory(path)
    relabel(path, path, **options)
    for before, after in zip(first, read_directory(path), strict=True):
        assert all(np.array_equal(before[key], after[key]) for key in before)
    assert list(tmp_path.iterdir()) == [path]


def test_log_is_a_stream(tmp_path, monkeypatch):
    """Of 60 episodes, no more than two batches are alive at a time."""
    monkeypatch.setattr(log_module, "BATCH_STEPS", 100)
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
            return map(CountedEpisode, logged_episodes(60))

    result = relabel(CountedLog(), tmp_path / "new", method="rd-linear", settings=SUM)
    assert result.episodes == 60
    assert most_alive < 20


def test_hold_out_flags_are_even():
    for share in (0.0, 0.05, 0.1, 0.25, 0.9):
        flags = [flag for flag, _ in zip(hold_out_flags(share, 0), range(1000), strict=False)]
        assert sum(flags) == round(1000 * share)
        assert all(abs(sum(flags[start : start + 100]) - 100 * share) <= 1 for start in range(0, 1000, 100))


RETURNS, PREDICTIONS = [0.0, 1.0, 0.0, 1.0, 9.0, 8.0, 9.0, 8.0], [0.1, 1.0, 0.0, 1.0, 9.0, 8.0, 9.0, 8.0]
EQUAL = [1e4 + 1e-4 * number for number in range(8)]  # but for rounding


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"returns": RETURNS[:7], "predictions": PREDICTIONS[:7]}, ["too_few"]),
        ({"returns": EQUAL}, ["constant"]),
        ({"predictions": EQUAL, "calibrated": False}, ["constant"]),
        ({"predictions": EQUAL}, ["r2", "worthless"]),
        ({"calibrated": False}, ["correlation"]),
        # The groups explain the returns, and the steps nothing.
        (
            {"groups": ["low"] * 4 + ["high"] * 4, "predictions": [0.0] * 4 + [9.0] * 4},
            ["r2", "within_groups", "worthless_within_groups"],
        ),
        ({"cut": 3}, ["cut", "r2"]),
    ],
)
def test_findings(changes, expected):
    values = {"out": "new", "method": "rd", "calibrated": True, "episodes": 1, "steps": 1000, "cut": 0}
    values |= {"returns": RETURNS, "predictions": PREDICTIONS, "groups": [], "explanation": ("Because.",)}
    result = Relabelled(**(values | changes))
    assert codes(result) == ["relabelled", *expected]
    assert result.summary == [*(render(finding, MESSAGES) for finding in result.findings), "Because."]
    assert "1,000 steps" in result.summary[0]
    assert "1 episode." in result.summary[0]


def test_old_output_is_kept(tmp_path):
    """If the second pass fails, and if the directory has other files."""

    class ChangingLog:
        passes = 0

        def __iter__(self):
            self.passes += 1
            return logged_episodes(20, seed=int(self.passes >= 5))

    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "mine.npz").write_text("old")
    message = "changed while it was read: it had 20 episodes of 483 steps, and now 20 episodes of"
    with pytest.raises(LareError, match=message):
        relabel(ChangingLog(), tmp_path / "new", method="rd-linear", settings=SUM, overwrite=True)
    assert [path.name for path in tmp_path.rglob("*")] == ["new", "mine.npz"]
    assert (tmp_path / "new" / "mine.npz").read_text() == "old"
    (tmp_path / "new" / "thesis.txt").write_text("years")
    with pytest.raises(LareError, match=r"new .*thesis\.txt"):
        relabel(list(logged_episodes(9)), tmp_path / "new", overwrite=True)
    assert (tmp_path / "new" / "thesis.txt").read_text() == "years"


@pytest.mark.parametrize(
    ("log", "options", "message"),
    [
        (None, {"method": "ircr"}, "ircr gives all steps"),
        (None, {"method": "dense"}, "dense assigns no credit"),
        (None, {"method": "lare-bayes"}, "lare-bayes needs a phi"),
        (None, {"hold_out": 1.0}, "hold_out = 1.0"),
        (None, {"memory": 0.0}, "memory = 0.0"),
        (None, {"updates": 0}, "updates = 0"),
        ([episode | {"cut": True} for episode in logged_episodes(3)], {}, "none of 3 episodes"),
        ([], {}, "no episode"),
        ([7], {}, "episode 0 must be a mapping"),
        (logged_episodes(3), {}, "read twice"),
    ],
)
def test_bad_arguments(tmp_path, log, options, message):
    with pytest.raises(LareError, match=message):
        relabel(list(logged_episodes(10)) if log is None else log, tmp_path / "new", **options)
    assert list(tmp_path.iterdir()) == []


def test_command(command, folder, tmp_path, task):
    path = folder(logged_episodes(40))
    keys = ("name", "environment", "observation_size", "action_size", "description", "observation", "action")
    (tmp_path / "task.toml").write_text("".join(f"{key} = {json.dumps(getattr(task, key))}\n" for key in keys))
    (tmp_path / "phi.py").write_text(PHI)
    options = ("--task", "task.toml", "--function", "phi.py", "--hold-out", 0.2, "--memory", 0.01)
    status, out, error = command("relabel", path, "--out", "new", *options)
    assert (status, error) == (0, "learning, 40 episodes\nwriting, 40 episodes\n")
    assert "lare-bayes" in out.splitlines()[0]
    assert "first" in out  # the rewarded factor
    assert "Warning" not in out
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


def test_terminated_command_leaves_nothing(command, folder, tmp_path, monkeypatch):
    class TerminatingStream(io.StringIO):
        def write(self, text):
            if "writing" in text:
                assert any(file.name.startswith(".new.") for file in tmp_path.iterdir())
                signal.raise_signal(signal.SIGTERM)
            return super().write(text)

    path, handler = folder(logged_episodes(10)), signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(sys, "stderr", TerminatingStream())
    try:
        status, _, _ = command("relabel", path, "--out", "new", "--method", "rd-linear", "--memory", 0.01)
    finally:
        signal.signal(signal.SIGTERM, handler)
    assert status == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.long
def test_predictions_of_odds_are_those_of_the_assigner(tmp_path):
    """The returns of binary scores are predicted by the odds, not by their straight line."""
    episodes = list(logged_episodes(200, max_length=8))
    sums = [episode.pop("rewards").sum() for episode in episodes]
    for episode, total in zip(episodes, sums, strict=True):
        episode["score"] = np.array(float(total > np.median(sums)))
    result = relabel(episodes, tmp_path / "new", settings=CreditSettings(score="binary"), hold_out=0.3)
    assert result.return_r2 > 0.8  # by a straight line: about 0.6


def test_groups_of_the_task_and_the_log_agree(tmp_path):
    episodes = list(logged_episodes(10))
    task = toy_spec(environment="none", observation_size=2, action_size=1, group="level")
    with pytest.raises(LareError, match="group = 'level'"):
        relabel(episodes, tmp_path / "new", task=task)
    for number, episode in enumerate(episodes):
        episode |= {"group": "easy"} if number != 4 else {}
    for hold_out in (0.0, 0.9):  # with the latter, it is held out
        with pytest.raises(LareError, match="episode 4 has no group"):
            relabel(episodes, tmp_path / "new", settings=SUM, hold_out=hold_out)


def test_r2_within_groups_of_equal_returns():
    """The rounding of a group's mean is no difference."""
    groups = ["easy"] * 6 + ["hard"] * 6
    assert np.isnan(_r2_within_groups([0.1] * 6 + [0.7] * 6, [0.2, 0.3] * 6, groups))
    r2 = _r2_within_groups([0.1, 0.2] * 3 + [0.7, 0.9] * 3, [0.1, 0.2] * 3 + [0.7, 0.8] * 3, groups)
    assert r2 == pytest.approx(0.8)
