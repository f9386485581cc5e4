"""Statistics of made-up runs, whose answers are known."""

import json

import numpy as np
import pytest

from lare_rl.compare import statistics
from lare_rl.compare.compare import (
    cells,
    cells_of_all,
    comparable,
    said_of,
    smallest_p,
    what_scores_are,
    write_comparisons,
)
from lare_rl.compare.scores import by_label
from lare_rl.compare.statistics import over_all, too_few
from lare_rl.errors import LareError


@pytest.fixture(autouse=True)
def few_repetitions(monkeypatch):
    monkeypatch.setattr(statistics, "REPETITIONS", 300)


def test_figures_by_hand(made):
    """The interquartile mean of 8 numbers leaves out the two at either end."""
    values = [-100.0, 1, 2, 3, 4, 5, 6, 1000]
    found = statistics.compare(by_label([made("a", values), made("b", [v + 0.5 for v in values], method="rrdu")]))
    first, second = found.rows
    assert first.iqm.value == pytest.approx(np.mean([2, 3, 4, 5]))
    assert first.mean == pytest.approx(np.mean(values))
    assert first.deviation == pytest.approx(np.std(values, ddof=1))
    assert first.iqm.low <= first.iqm.value <= first.iqm.high
    assert first.better is None
    pairs = [(x + 0.5 > y) + 0.5 * (x + 0.5 == y) for x in values for y in values]
    assert second.better.value == pytest.approx(np.mean(pairs))
    np.testing.assert_allclose(found.curves["dense"].x, [50, 100])
    np.testing.assert_allclose(found.curves["dense"].value, [3.5 / 2, 3.5])
    profile = found.profiles["dense"]
    np.testing.assert_allclose(profile.value, [np.mean(np.array(values) > x) for x in profile.x])


@pytest.mark.parametrize(("runs", "tasks"), [(1, 1), (3, 1), (3, 2), (8, 3)])
def test_what_is_bootstrapped_are_the_metrics_of_rliable(runs, tasks):
    random = np.random.default_rng(0)
    statistics.rliable()
    from rliable import metrics

    scores = random.normal(size=(runs, tasks, 7))
    want = [metrics.aggregate_iqm(scores[..., step]) for step in range(7)]
    np.testing.assert_allclose(statistics.interquartile_means(scores), want)
    mine, first = random.integers(0, 5, (runs, tasks)), random.integers(0, 5, (4, tasks))  # with ties
    want = metrics.probability_of_improvement(mine, first)
    assert statistics.probability_of_improvement(mine.astype(float), first.astype(float)) == pytest.approx(want)


def test_mann_and_whitneys_test_by_hand():
    """By the tables of Mann and Whitney: of 3 against 3, all nine pairs 1 in 20, eight or more 2 in 20."""
    low, high = np.array([1.0, 2, 3]), np.array([4.0, 5, 6])
    assert statistics.mann_whitney([(high, low)]) == pytest.approx((1 / 20, 1))
    assert statistics.mann_whitney([(np.array([3.0, 5, 6]), np.array([1.0, 2, 4]))])[0] == pytest.approx(2 / 20)
    assert statistics.mann_whitney([(low, high)]) == pytest.approx((1, 1 / 20))
    assert statistics.mann_whitney([(high, low), (high, low)])[0] == pytest.approx(1 / 400)
    assert min(statistics.mann_whitney([(low, low)])) > 0.5


def test_intervals_hold_what_they_promise():
    """Of the mean of 10 normal numbers, in most of 60 tries; a bootstrap of few is a little too sure of itself."""
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(60):
        (one,) = statistics.estimates(rng.normal(size=(10, 1)), lambda scores: np.array([scores.mean()]))
        inside += one.low <= 0 <= one.high
    assert 46 <= inside <= 60


def test_the_same_runs_give_the_same_intervals(made):
    runs = by_label([made("a", [1.0, 2, 5])])
    assert statistics.compare(runs).rows == statistics.compare(runs).rows


def test_draws_are_told_apart_from_seeds(made):
    """Seeds differ by 100, draws by 1: the interval over draws is the narrow one."""
    runs = [made(f"draw{draw}", [draw, draw + 100.0], method="lare-rrdu", draw=draw) for draw in range(3)]
    (row,) = statistics.compare(by_label(runs)).rows
    assert (row.seeds, row.draws) == (2, 3)
    assert row.over_draws.value == pytest.approx(51)
    assert (row.over_draws.low, row.over_draws.high) == (pytest.approx(50, abs=0.5), pytest.approx(52, abs=0.5))
    assert row.iqm.high - row.iqm.low == pytest.approx(100)
    head, (shown,) = cells(statistics.compare(by_label(runs)))
    assert dict(zip(head, shown, strict=True))["draws"] == "3"
    assert "draws" not in cells(statistics.compare(by_label(runs[:1])))[0]


def test_several_tasks_are_laid_between_fixed_ends(made, tmp_path):
    runs = [made("a", [-44.0, -2.7], "Reacher-v4"), made("b", [4600.0, 4600.0], "Walker2d-v4")]
    (found,) = write_comparisons(by_label(runs), tmp_path / "page.html")
    assert found.normalised
    assert found.rows[0].mean == pytest.approx(np.mean([0, 1, 1, 1]))
    page = (tmp_path / "page.html").read_text()
    assert "Reacher-v4: 0 is -44, 1 is -2.7; Walker2d-v4: 0 is 3.4, 1 is 4600." in page
    assert page.count("<svg") == 2


def test_tasks_without_a_common_scale_have_a_table_each(made, tmp_path):
    runs = [made("a", [1.0, 3.0]), made("b", [2.0, 4.0], method="rd"), made("c", [7.0, 9.0], task="Reacher-v4")]
    one, other = write_comparisons(by_label(runs), tmp_path / "page.html")
    assert (one.tasks, [row.label for row in one.rows], one.rows[0].mean) == (("Chase",), ["dense", "rd"], 2.0)
    assert (other.tasks, [row.label for row in other.rows], other.rows[0].mean) == (("Reacher-v4",), ["dense"], 8.0)
    page = (tmp_path / "page.html").read_text()
    assert "<h2>Chase</h2>" in page
    assert "<h2>Reacher-v4</h2>" in page


def test_tasks_without_a_common_scale_are_compared_together_by_the_order_of_their_runs(made, tmp_path):
    low, high = [1.0, 2, 3], [4.0, 5, 6]
    runs = [made("a", low), made("b", high, method="rd"), made("c", high, method="rrd")]
    runs += [
        made("a", [100 * one for one in low], "Depot"),
        made("b", [100 * one for one in high], "Depot", method="rd"),
    ]
    runs += [made("c", high[:2], "Depot", method="rrd")]
    found = write_comparisons(by_label(runs), tmp_path / "page.html")
    first, second = over_all(found)  # without rrd, which has fewer seeds on one of the tasks
    assert (first.label, first.better, first.p) == ("dense", None, None)
    assert (second.label, second.seeds, second.better.value) == ("rd", 3, 1)
    assert second.p == pytest.approx(1 / 400)
    assert cells_of_all(found) == [("dense (baseline)", "3", "-", "-"), ("rd", "3", "1.000", "0.0025")]
    assert "<h2>All tasks</h2>" in (tmp_path / "page.html").read_text()
    other = write_comparisons(by_label(runs[:2] + runs[4:]), tmp_path / "page.html")
    assert over_all(other) == []  # no dense on Depot
    assert over_all(found[:1]) == []
    assert "All tasks" not in (tmp_path / "page.html").read_text()


def test_the_difference_from_the_baseline_has_an_interval_of_both_methods(made):
    """Each method scores 0 or 10 more, so the difference of two draws is 10 less to 10 more than that of the means."""
    runs = [made("a", [0.0, 10.0]), made("b", [100.0, 110.0], method="rd"), made("c", [1.0], method="rrd")]
    first, second, single = statistics.compare(by_label(runs)).rows
    assert (first.difference, single.difference) == (None, None)
    assert second.difference == statistics.Estimate(100.0, 90.0, 110.0)


def test_scores_are_compared_at_a_step_and_over_the_last_quarter(made, command, tmp_path):
    """Five evaluations: the scores are a fifth, two fifths, ... of the last one."""
    steps = (20, 40, 60, 80, 100)
    runs = [made("a", [5.0, 15.0], steps=steps), made("b", [10.0, 20.0], method="rd", steps=steps)]
    labels = by_label(runs)
    late = statistics.compare(labels, late=True)
    assert [row.mean for row in late.rows] == pytest.approx([9.0, 13.5])  # steps 80 and 100
    assert what_scores_are(late) == (
        "Scores are true returns on Chase averaged over the evaluations after three quarters of 100 steps."
    )
    early = statistics.compare(labels, step=60)
    assert [row.mean for row in early.rows] == pytest.approx([6.0, 9.0])
    assert list(early.curves["rd"].x) == [20, 40, 60]
    assert what_scores_are(early) == "Scores are true returns on Chase at step 60."
    with pytest.raises(
        LareError,
        match=r"^not all runs have a value of evaluation/return at step 50: all have one at 20, 40, 60, 80, 100$",
    ):
        statistics.compare(labels, step=50)
    places = [run.directory for run in runs]
    status, out, _ = command("compare", *places, "--at", 80, "--late", "--out", tmp_path / "late.html")
    assert status == 0
    assert "after three quarters of 80 steps" in out
    assert "after three quarters of 80 steps" in (tmp_path / "late.html").read_text()


def test_the_page_says_where_its_runs_come_from(made, tmp_path):
    runs = [made("a", [1.0, 2.0]), made("b", [3.0, 4.0], method="rd")]
    write_comparisons(by_label(runs), tmp_path / "page.html")
    config = runs[0].config
    said = f"LaRe {config.lare}, JAX {config.versions['jax']}, {config.machine}, 10 episodes in each evaluation."
    assert f"Runs: {said}" in (tmp_path / "page.html").read_text()


def test_a_missing_table_over_all_tasks_is_said(made, command):
    runs = [made("a", [1.0, 3.0]), made("b", [2.0, 4.0], method="rd"), made("c", [7.0, 9.0], "Depot", method="rd")]
    status, out, _ = command("compare", *(run.directory for run in runs))
    assert status == 0
    assert "\nNo table over all tasks: it needs the same baseline, and another method, on every task" in out


def test_something_else_than_the_return_is_compared(made):
    run = made("a", [1.0, 3.0])
    lines = [line | {"credit/error": 2 * line["seed"]} for line in run.metrics()]
    (run.directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert statistics.compare(by_label([run]), "credit/error").rows[0].mean == 1.0
    lines = [line | ({"credit/error": None} if line["seed"] == 1 else {}) for line in lines]
    (run.directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(LareError, match=r"Chase/a has no credit/error of seed 1 at any step: leave it out$"):
        statistics.compare(by_label([run]), "credit/error")
    without = made("b", [1.0, 3.0], method="rd")
    found, remarks = comparable([run, without], "credit/error")
    assert (found, remarks[-1]) == ([run], f"{without.directory} has no credit/error, and is left out")
    with pytest.raises(
        LareError, match=r"^no run has the metric 'credit/error'; they have critic/loss, evaluation/return$"
    ):
        comparable([without], "credit/error")
    lines = [line | {"credit/error": None} for line in without.metrics()]
    (without.directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(
        LareError, match=r"^no run has a value of credit/error yet: it is null in all of their evaluations$"
    ):
        comparable([without], "credit/error")


def test_runs_without_an_evaluation_are_left_out_and_unfinished_ones_named(made):
    ended, begun, killed = (
        made(name, [1.0], method=method, steps=steps, td3={"warmup": 10})
        for name, method, steps in (("a", "dense", (50, 100)), ("b", "rd", (25, 50)), ("c", "dense", ()))
    )
    found, remarks = comparable([ended, begun, killed])
    assert [run.directory for run in found] == [ended.directory, begun.directory]
    assert remarks == [
        f"{begun.directory} has only reached step 50 of 100, so no run is compared at a later step",
        f"{killed.directory} has no evaluation yet, and is left out",
    ]
    with pytest.raises(LareError, match=r"runs/Chase/c: no run has an evaluation yet$"):
        comparable([killed])


RANGE = "the bootstrap's interval can only be their range, which holds the true median in"


@pytest.mark.parametrize(
    ("tasks", "runs", "said"),
    [
        (["Walker2d-v4"], [[1.0, 2.0, 3.0]], f"Of three seeds {RANGE} three of four cases, not in 95 of 100."),
        (["Walker2d-v4"], [[1.0, 2.0]], f"Of two seeds {RANGE} one of two cases, not in 95 of 100."),
        (["Walker2d-v4"], [[1.0] * 4] * 2, f"Of two draws {RANGE} one of two cases, not in 95 of 100."),
        (["Walker2d-v4"], [[1.0] * 4] * 4, ""),
        (["Walker2d-v4"], [[1.0]], ""),
        (
            ["Walker2d-v4", "Reacher-v4"],
            [[1.0, 2.0, 3.0]],
            "Intervals of two or three seeds, or draws, are too narrow: they hold the true median in less than 95 of 100 cases.",
        ),
    ],
)
def test_what_few_seeds_or_draws_cannot_say(tasks, runs, said, made):
    opened = [
        made(f"draw{draw}", returns, task, method="lare-rd", draw=draw)
        for task in tasks
        for draw, returns in enumerate(runs)
    ]
    assert too_few(statistics.compare(by_label(opened))) == said


@pytest.mark.parametrize(
    ("mean", "spread", "shown"),
    [
        (4576.2, 349.1, "4576 ± 349"),
        (0.4505, 0.115, "0.451 ± 0.115"),
        (0.0002, 0.00021, "0.000200 ± 0.000210"),
        (0.5, 0.0, "0.5000 ± 0.000"),
        (1.23e-7, 4e-8, "1.23e-07 ± 4.00e-08"),
        (3.0, 1e-9, "3.000000 ± 1.00e-09"),
    ],
)
def test_three_digits_of_the_spread(mean, spread, shown):
    assert statistics.plus_minus(mean, spread) == shown


def test_the_interval_of_three_seeds_is_their_range(made):
    (row,) = statistics.compare(by_label([made("a", [1.0, 2.0, 6.0])])).rows
    assert (row.iqm.low, row.iqm.high) == (1.0, 6.0)


def test_a_probability_of_one_has_its_chance_beside_it(made):
    """Two seeds above two others: one of the six ways to deal four numbers."""
    runs = [made("a", [1.0, 2.0]), made("b", [3.0, 4.0], method="rd"), made("c", [0.0, 0.5], method="rrdu")]
    first, better, worse = statistics.compare(by_label(runs)).rows
    assert first.p is None
    assert (str(better.better), better.p) == ("1.000", pytest.approx(1 / 6))
    assert (str(worse.better), worse.p) == ("0.000", pytest.approx(1 / 6))
    compared = statistics.compare(by_label(runs))
    head, rows = cells(compared)
    assert (head[-1], rows[1][-1]) == ("p", "0.17")
    assert smallest_p(compared) == "With so few runs, p is at least 0.17."
    assert said_of(compared).endswith("not in 95 of 100. With so few runs, p is at least 0.17.")
    many = by_label([made("d", [1.0, 2, 3, 4]), made("e", [1.0, 2, 3, 4], method="rd")])
    assert smallest_p(statistics.compare(many)) == ""


def test_single_seeds_have_no_intervals(made):
    compared = statistics.compare(by_label([made("a", [-347.3176]), made("b", [2.0], method="rd")]))
    assert cells(compared)[1] == [
        ("dense (baseline)", "1", "-347.3", "-347.3", "-", "-", "-"),
        ("rd", "1", "2.000", "2.000", "-", "-", "-"),
    ]
    assert what_scores_are(compared).endswith(" at step 100, the last at which all runs were evaluated.")
