"""Statistics of made-up runs, whose answers are known."""

import json
from pathlib import Path

import numpy as np
import pytest

from lare.errors import LareError
from lare.experiments import statistics
from lare.experiments.compare import cells, find_runs, what_scores_are, write_comparison
from lare.experiments.statistics import by_label, too_few
from lare.training.run import Run, describe
from lare.training.settings import Settings, decide
from toys import toy_spec


@pytest.fixture(autouse=True)
def few_repetitions(monkeypatch):
    monkeypatch.setattr(statistics, "REPETITIONS", 300)


@pytest.fixture
def made(tmp_path):
    """Makes a run directory: configuration and metrics, nothing trained."""

    def make(name, returns, task="Chase", steps=(50, 100), method="dense", **settings):
        spec = toy_spec(name=task)
        plan = decide(Settings(method=method, steps=100, seeds=len(returns), **settings), spec)
        directory = tmp_path / "runs" / task / name
        directory.mkdir(parents=True)
        config = describe(spec, plan, ())
        (directory / "config.json").write_text(config.model_dump_json())
        lines = [
            {"step": step, "seed": seed, "evaluation/return": value * share}
            for step, share in zip(steps, (0.5, 1.0), strict=bool(steps))
            for seed, value in zip(plan.all_seeds, returns, strict=True)
        ]
        (directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        return Run(directory, config, ())

    return make


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


def test_mann_and_whitneys_test_by_hand():
    """By the tables of Mann and Whitney: of 3 against 3, all nine pairs 1 in 20, eight or more 2 in 20."""
    low, high = np.array([1.0, 2, 3]), np.array([4.0, 5, 6])
    assert statistics.mann_whitney_p([(high, low)]) == pytest.approx(1 / 20)
    assert statistics.mann_whitney_p([(np.array([3.0, 5, 6]), np.array([1.0, 2, 4]))]) == pytest.approx(2 / 20)
    assert statistics.mann_whitney_p([(low, high)]) == pytest.approx(1)
    assert statistics.mann_whitney_p([(high, low), (high, low)]) == pytest.approx(1 / 400)
    assert statistics.mann_whitney_p([(low, low)]) > 0.5


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


def test_several_tasks_are_laid_between_fixed_ends(made, tmp_path):
    runs = [made("a", [-44.0, -2.7], "Reacher-v4"), made("b", [4600.0, 4600.0], "Walker2d-v4")]
    found = write_comparison(runs, tmp_path / "page.html")
    assert found.normalised
    assert found.rows[0].mean == pytest.approx(np.mean([0, 1, 1, 1]))
    page = (tmp_path / "page.html").read_text()
    assert "Reacher-v4: 0 is -44, 1 is -2.7; Walker2d-v4: 0 is 3.4, 1 is 4600." in page
    assert page.count("<svg") == 2


def test_tasks_that_judge_differently_are_laid_side_by_side():
    """Reacher-v4 judges the observation before a step, the others the one after it: that makes no other method of one."""
    kept = Path(__file__).parents[2] / "benchmarks" / "results" / "reproduce" / "laptop"
    runs = find_runs(
        [kept / task / f"{name}-td3" for task in ("Reacher-v4", "Walker2d-v4") for name in ("dense", "rrdu")]
    )
    runs += find_runs([kept / task / "lare-rrdu-td3-draw0" for task in ("Reacher-v4", "Walker2d-v4")])
    found = statistics.compare(by_label(runs))
    assert (found.tasks, list(found.groups)) == (("Reacher-v4", "Walker2d-v4"), ["dense", "rrdu", "lare-rrdu"])


def test_runs_of_one_method_are_told_apart_by_their_settings(made):
    slow = {"credit": {"learning_rate": 1e-4}}
    runs = [made("a", [1.0], method="rd"), made("b", [2.0], method="rd", **slow), made("c", [3.0])]
    names = list(by_label(runs))
    assert names == ["rd, credit.learning_rate 0.0003", "rd, credit.learning_rate 0.0001", "dense"]
    runs.append(made("d", [3.0], algorithm="ddpg"))
    assert list(by_label(runs))[1:] == ["rd, td3, credit.learning_rate 0.0001", "dense, td3", "dense, ddpg"]


def with_function(run, *digests):
    return Run(run.directory, run.config.model_copy(update={"function_sha256": digests}), ())


def test_runs_of_two_functions_are_told_apart_by_them(made):
    """Whatever their seeds are; and not where two draws of the language model make up one row."""
    first, second = made("a", [1.0], method="lare-rd"), made("b", [2.0], method="lare-rd", seed=1)
    dense, one, other = made("c", [3.0]), "0123456789abcdef", "fedcba9876543210"
    runs = [with_function(first, one), with_function(second, other), dense]
    assert list(by_label(runs)) == ["lare-rd, phi 01234567", "lare-rd, phi fedcba98", "dense"]
    assert list(by_label([with_function(first, one), with_function(second, one)])) == ["lare-rd"]
    drawn = made("d", [2.0], method="lare-rd", draw=1)
    found = by_label([with_function(first, one), with_function(drawn, other)])
    assert {label: len(runs) for label, runs in found.items()} == {"lare-rd": 2}


def test_two_tasks_of_one_name_are_not_compared(made):
    first, second = made("a", [1.0]), made("b", [2.0], method="rd")
    second = Run(second.directory, second.config.model_copy(update={"task": toy_spec(judges="after")}), ())
    with pytest.raises(LareError) as error:
        statistics.compare(by_label([first, second]))
    assert str(error.value) == (
        f"{second.directory} and {first.directory} are runs of two tasks that are both called Chase: compare them apart"
    )


def test_something_else_than_the_return_is_compared(made):
    run = made("a", [1.0, 3.0])
    lines = [line | {"credit/error": 2 * line["seed"]} for line in run.metrics()]
    (run.directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert statistics.compare(by_label([run]), "credit/error").rows[0].mean == 1.0


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        (
            [("a", "Chase", {}), ("b", "Reacher-v4", {})],
            "there is no reference for Chase, so its returns cannot be laid beside those of other tasks: compare the runs of "
            "each task by themselves",
        ),
        (
            [("a", "Chase", {}), ("b", "Chase", {"evaluation_episodes": 3})],
            "{runs}/Chase/b and {runs}/Chase/a are both dense on Chase with seed 0: leave one out",
        ),
        (
            [("a", "Walker2d-v4", {}), ("a", "Reacher-v4", {}), ("b", "Reacher-v4", {"seed": 2})],
            "dense on Walker2d-v4 lacks a run with seed 2 and draw 0, which it has elsewhere",
        ),
        (
            [("a", "Chase", {}), ("b", "Chase", {"seed": 2, "steps": (60, 70)})],
            "the runs have no step in common at which all of them were evaluated",
        ),
        (
            [("a", "Chase", {}), ("b", "Chase", {"seed": 2, "steps": ()})],
            "{runs}/Chase/b has no evaluation yet: leave it out",
        ),
    ],
)
def test_what_cannot_be_compared(runs, message, made, tmp_path):
    opened = [made(name, [1.0, 2.0], task, **settings) for name, task, settings in runs]
    with pytest.raises(LareError) as error:
        statistics.compare(by_label(opened))
    assert str(error.value) == message.format(runs=tmp_path / "runs")


def test_runs_are_found_in_the_directory_of_a_sweep(made, tmp_path):
    made("a", [1.0]), made("b", [2.0], method="rd")
    found = find_runs([tmp_path / "runs"])
    assert [run.config.settings.method for run in found] == ["dense", "rd"]
    assert find_runs([tmp_path / "runs" / "Chase" / "a"])[0].directory == found[0].directory
    assert [run.directory for run in find_runs([tmp_path / "runs" / "Chase"])] == [run.directory for run in found]
    with pytest.raises(LareError, match=r"nothing is no run, and there is none in it$"):
        find_runs([tmp_path / "nothing"])


def test_what_the_task_says_anyway_makes_no_other_method(made):
    runs = [made("a", [1.0], method="lare-rd"), made("b", [2.0], method="lare-rd", judges=toy_spec().judges)]
    assert list(by_label(runs)) == ["lare-rd"]
    runs = [made("c", [1.0]), made("d", [2.0], judges="after", credit={"hidden": (8,)}, draw=3)]
    assert list(by_label(runs)) == ["dense"]
    assert list(by_label([made("e", [1.0], method="lare-rd", judges="after"), runs[0]])) == ["lare-rd", "dense"]


RANGE = "the bootstrap's interval can only be their range, which holds the true mean in"


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
            "Intervals of two or three seeds, or draws, are too narrow: they hold the true mean in less than 95 of 100 cases.",
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
    ],
)
def test_three_digits_of_the_spread(mean, spread, shown):
    assert statistics.plus_minus(mean, spread) == shown


def test_the_interval_of_three_seeds_is_their_range(made):
    (row,) = statistics.compare(by_label([made("a", [1.0, 2.0, 6.0])])).rows
    assert (row.iqm.low, row.iqm.high) == (1.0, 6.0)


def test_single_seeds_have_no_intervals(made):
    compared = statistics.compare(by_label([made("a", [-347.3176]), made("b", [2.0], method="rd")]))
    assert cells(compared) == [
        ("dense", "1", "1", "-347.3", "-347.3", "-", "-"),
        ("rd", "1", "1", "2.000", "2.000", "-", "-"),
    ]
    assert what_scores_are(compared).endswith(" at step 100, the last at which all runs were evaluated.")
