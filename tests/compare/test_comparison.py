import numpy as np
import pytest

from lare_rl.compare import bootstrap
from lare_rl.compare.bootstrap import Estimate
from lare_rl.compare.comparison import compare, compare_over_tasks, compare_tasks
from lare_rl.compare.labels import label_runs
from lare_rl.compare.results import read_run_results
from lare_rl.compare.scores import ScoreChoice, group_results
from lare_rl.errors import LareError
from lare_rl.runs.metric_names import RETURN

DRAWN = {"method": "lare-rd"}


def read(runs, metric=RETURN):
    return read_run_results(label_runs(runs), metric)


def test_compare_by_hand(make_run):
    """The interquartile mean of 8 numbers leaves out the two at either end."""
    values = [-100.0, 1, 2, 3, 4, 5, 6, 1000]
    runs = [make_run("a", values), make_run("b", [value + 0.5 for value in values], method="rrdu")]
    comparison = compare(read(runs))
    first, second = comparison.rows
    assert first.iqm.value == pytest.approx(np.mean([2, 3, 4, 5]))
    assert first.mean == pytest.approx(np.mean(values))
    assert first.std == pytest.approx(np.std(values, ddof=1))
    assert first.iqm.low <= first.iqm.value <= first.iqm.high
    assert (first.probability_of_improvement, first.difference, first.p_value) == (None, None, None)
    pairs = [(x + 0.5 > y) + 0.5 * (x + 0.5 == y) for x in values for y in values]
    assert second.probability_of_improvement.value == pytest.approx(np.mean(pairs))
    np.testing.assert_allclose(comparison.curves["dense"].x, [50, 100])
    np.testing.assert_allclose(comparison.curves["dense"].value, [3.5 / 2, 3.5])
    profile = comparison.profiles["dense"]
    np.testing.assert_allclose(profile.value, [np.mean(np.array(values) > x) for x in profile.x])
    assert compare(read(runs)).rows == comparison.rows  # the bootstrap is deterministic


def test_draws_and_seeds(make_run):
    """Seeds differ by 100, draws by 1, so that the interval over draws is narrow."""
    runs = [make_run(f"draw{draw}", [draw, draw + 100.0], method="lare-rrdu", draw=draw) for draw in range(3)]
    (row,) = compare(read(runs)).rows
    assert (row.n_seeds, row.n_draws) == (2, 3)
    assert row.draw_mean.value == pytest.approx(51)
    assert (row.draw_mean.low, row.draw_mean.high) == (pytest.approx(50, abs=0.5), pytest.approx(52, abs=0.5))
    assert row.iqm.high - row.iqm.low == pytest.approx(100)


def test_tasks_without_common_scale(make_run):
    """They are compared alone and, by the order of their runs, together."""
    low, high = [1.0, 2, 3], [4.0, 5, 6]
    runs = [make_run("a", low), make_run("b", high, method="rd"), make_run("c", high, method="rrd")]
    low, high = [100.0, 200, 300], [400.0, 500, 600]
    runs += [make_run("a", low, "Depot"), make_run("b", high, "Depot", method="rd")]
    runs += [make_run("c", high[:2], "Depot", method="rrd")]
    comparisons = compare_tasks(read(runs))
    means = [(comparison.task, comparison.rows[0].mean) for comparison in comparisons]
    assert means == [("Chase", 2), ("Depot", 200)]
    first, second = compare_over_tasks(comparisons)  # without rrd, which has fewer seeds on one of the tasks
    assert (first.label, first.probability_of_improvement, first.p_value) == ("dense", None, None)
    assert (second.label, second.n_seeds, second.probability_of_improvement.value) == ("rd", 3, 1)
    assert second.p_value == pytest.approx(1 / 200)
    assert compare_over_tasks(compare_tasks(read(runs[:2] + runs[4:]))) == []  # dense is not on Depot
    assert compare_over_tasks(comparisons[:1]) == []
    results = sorted(read([*runs[:5], make_run("d", high, "Depot", method="rrd")]), key=lambda result: result.task)
    assert compare_over_tasks(compare_tasks(results[:9] + results[:8:-1])) == []  # the baseline of Depot is rrd


def test_interval_of_difference(make_run, monkeypatch):
    """Each method scores 0 or 10 more, so the difference is at most 10 less or 10 more than the difference of the means."""
    monkeypatch.setattr(bootstrap, "REPETITIONS", 300)
    runs = [make_run("a", [0.0, 10.0]), make_run("b", [100.0, 110.0], method="rd"), make_run("c", [1.0], method="rrd")]
    _, second, single = compare(read(runs)).rows
    assert second.difference == Estimate(100.0, 90.0, 110.0)
    assert (single.difference, single.probability_of_improvement, single.p_value) == (None, None, None)
    assert single.iqm == Estimate(1.0, 1.0, 1.0)
    (three,) = compare(read([make_run("d", [1.0, 2.0, 6.0])])).rows
    assert (three.iqm.low, three.iqm.high) == (1.0, 6.0)


def test_step_and_last_quarter(make_run):
    """The scores at the five evaluations are a fifth, two fifths, ... of the last one."""
    steps = (20, 40, 60, 80, 100)
    runs = [make_run("a", [5.0, 15.0], steps=steps), make_run("b", [10.0, 20.0], method="rd", steps=steps)]
    late = compare(read(runs), ScoreChoice(average_last_quarter=True))
    assert [row.mean for row in late.rows] == pytest.approx([9.0, 13.5])  # steps 80 and 100
    early = compare(read(runs), ScoreChoice(step=60))
    assert [row.mean for row in early.rows] == pytest.approx([6.0, 9.0])
    assert list(early.curves["rd"].x) == [20, 40, 60]
    with pytest.raises(LareError, match=r"at step 50; .*20, 40, 60, 80, 100"):
        compare(read(runs), ScoreChoice(step=50))


@pytest.mark.parametrize(
    ("runs", "metric", "message"),
    [
        ([], RETURN, "no results"),
        ([("a", "Chase", {}), ("b", "Reacher-v4", {})], RETURN, "no common scale over Chase, Reacher"),
        (
            [("a", "Chase", DRAWN), ("b", "Chase", DRAWN | {"draw": 1, "seed": 2})],
            RETURN,
            "no run on Chase with seed 2 and draw 0",
        ),
        ([("a", "Chase", {}), ("b", "Chase", {"seed": 2, "steps": (60, 70)})], RETURN, "a: 50 to 100; .*b: 60 to 70"),
        ([("a", "Chase", {}), ("b", "Chase", {"seed": 2, "steps": ()})], RETURN, "Chase/b has no evaluation/return"),
    ],
)
def test_bad_runs(runs, metric, message, make_run):
    runs = [make_run(name, [1.0, 2.0], task, **settings) for name, task, settings in runs]
    with pytest.raises(LareError, match=message):
        compare(read(runs, metric), ScoreChoice(metric))


def test_same_draw_twice(make_run):
    runs = [make_run(name, [1.0], method="lare-rrdu", draw=2) for name in "ab"]
    with pytest.raises(LareError, match=r"seed 0 .*draw 2"):
        group_results(read_run_results({"A": runs}, RETURN))
