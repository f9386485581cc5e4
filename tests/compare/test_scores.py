"""Which runs make up a row of a comparison, and which cannot be compared."""

from pathlib import Path

import pytest

from helpers.toys import toy_spec
from lare_rl.compare.compare import find_all
from lare_rl.compare.scores import RETURN, by_label, differing, grouped
from lare_rl.errors import LareError
from lare_rl.runs.directory import Run, read_measured
from lare_rl.runs.discover import run_directories


def test_tasks_that_judge_differently_are_laid_side_by_side():
    """Reacher-v4 judges the observation before a step, the others the one after it: that makes no other method of one."""
    kept = Path(__file__).parents[2] / "benchmarks" / "results" / "reproduce" / "laptop"
    of_methods = [f"{name}-td3" for name in ("dense", "rrdu")] + ["lare-rrdu-td3-draw0"]
    places = [kept / task / name for name in of_methods for task in ("Reacher-v4", "Walker2d-v4")]
    runs = [read_measured(directory) for directory in run_directories(places)]
    groups, tasks = grouped(by_label(runs), RETURN)
    assert (tasks, [group.label for group in groups]) == (("Reacher-v4", "Walker2d-v4"), ["dense", "rrdu", "lare-rrdu"])


def test_runs_of_one_method_are_told_apart_by_their_settings(made):
    slow = {"credit": {"learning_rate": 1e-4}}
    runs = [made("a", [1.0], method="rd"), made("b", [2.0], method="rd", **slow), made("c", [3.0])]
    names = list(by_label(runs))
    assert names == ["rd, credit.learning_rate 0.0003", "rd, credit.learning_rate 0.0001", "dense"]
    runs.append(made("d", [3.0], algorithm="ddpg"))
    assert list(by_label(runs))[1:] == ["rd, td3, credit.learning_rate 0.0001", "dense, td3", "dense, ddpg"]


def test_settings_that_differ_from_task_to_task_make_one_method_all_the_same(made):
    """Unless they also differ on one task: then every run is named after them."""
    runs = [made("a", [1.0], td3={"warmup": 10}), made("a", [2.0], "Depot", td3={"warmup": 20})]
    assert list(by_label(runs)) == ["dense"]
    runs.append(made("b", [3.0], td3={"warmup": 20}))
    found = {label: [run.config.task.name for run in some] for label, some in by_label(runs).items()}
    assert found == {"dense, td3.warmup 10": ["Chase"], "dense, td3.warmup 20": ["Depot", "Chase"]}


def with_function(run, *digests):
    return Run(run.directory, run.config.model_copy(update={"function_sha256": digests}), ())


def test_a_method_has_one_label_on_tasks_that_are_trained_by_other_algorithms(made):
    runs = [made("a", [1.0], algorithm="td3"), made("a", [2.0], "Depot", algorithm="ddpg")]
    assert list(by_label(runs)) == ["dense"]


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


def test_two_trainings_of_a_method_are_told_apart_by_their_directories(made):
    """If they share a seed. Runs of other seeds are more seeds of the same row."""
    old, new, more = made("old", [1.0]), made("new", [2.0], evaluation_episodes=3), made("more", [3.0], seed=1)
    assert {label: len(runs) for label, runs in by_label([old, more]).items()} == {"dense": 2}
    assert list(by_label([old, new, more])) == ["dense, old", "dense, new", "dense, more"]
    again = made("old", [1.0], "Reacher-v4")
    assert list(by_label([old, again])) == ["dense"]
    groups, _ = grouped(by_label([old, new]), RETURN)
    assert [(group.label, float(group.scores[0, 0, 0, -1])) for group in groups] == [
        ("dense, old", 1.0),
        ("dense, new", 2.0),
    ]


def test_trainings_in_two_directories_of_sweeps_are_named_after_these(made):
    runs = [made(f"{study}/dense-td3", [1.0]) for study in ("one", "two")]
    assert list(by_label(runs)) == ["dense, one", "dense, two"]


def test_two_tasks_of_one_name_are_not_compared(made):
    first, second = made("a", [1.0]), made("b", [2.0], method="rd")
    second = Run(second.directory, second.config.model_copy(update={"task": toy_spec(judges="after")}), ())
    with pytest.raises(LareError) as error:
        grouped(by_label([first, second]), RETURN)
    assert str(error.value) == (
        f"{second.directory} and {first.directory} are runs of two tasks that are both called Chase: compare them separately"
    )


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        (
            [("a", "Chase", {}), ("b", "Reacher-v4", {})],
            "there is no reference for Chase, so its returns cannot be compared with those of other tasks: compare the runs of "
            "each task by themselves",
        ),
        (
            [("a", "Walker2d-v4", {}), ("a", "Reacher-v4", {}), ("b", "Reacher-v4", {"seed": 2})],
            "dense on Walker2d-v4 lacks a run with seed 2, which it has on another task: train it, or compare each task by itself",
        ),
        (
            [("a", "Chase", {}), ("b", "Chase", {"seed": 2, "steps": (60, 70)})],
            "the runs have no step in common at which all of them have a value of evaluation/return: {runs}/Chase/a from 50 to "
            "100; {runs}/Chase/b from 60 to 70",
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
        grouped(by_label(opened), RETURN)
    assert str(error.value) == message.format(runs=tmp_path / "runs")


def test_what_the_task_says_anyway_makes_no_other_method(made):
    runs = [made("a", [1.0], method="lare-rd"), made("b", [2.0], method="lare-rd", judges=toy_spec().judges, seed=1)]
    assert list(by_label(runs)) == ["lare-rd"]
    runs = [made("c", [1.0]), made("d", [2.0], judges="after", credit={"hidden": (8,)}, draw=3, seed=1)]
    assert list(by_label(runs)) == ["dense"]
    assert list(by_label([made("e", [1.0], method="lare-rd", judges="after"), runs[0]])) == ["lare-rd", "dense"]


def test_settings_in_which_runs_differ_are_named(made):
    settings = [{"td3": {"warmup": 10}}, {"td3": {"warmup": 20}, "method": "rd"}, {"algorithm": "ddpg"}]
    runs = [made(str(place), [1.0], **given) for place, given in enumerate(settings)]
    assert differing(runs) == ["td3.warmup (10: dense; 20: rd)"]
    remarks = find_all([run.directory for run in runs[:2]], RETURN)[1]
    assert remarks == ["the runs also differ in td3.warmup (10: dense; 20: rd)"]
    assert differing(runs[1:]) == []


def test_methods_with_different_functions_are_named(made):
    def of(method, digest, place, **settings):
        run = made(f"{method}-{place}", [1.0], method=method, **settings)
        return Run(run.directory, run.config.model_copy(update={"function_sha256": (digest,)}), ())

    recorded, own = of("lare-bayes", 8 * "a", 0), of("lare-rd", 8 * "b", 1)
    assert differing([recorded, own]) == ["phi on Chase (aaaaaaaa: lare-bayes; bbbbbbbb: lare-rd)"]
    assert differing([recorded, of("lare-rd", 8 * "a", 2), made("dense", [1.0])]) == []
    draws = [
        of(method, 8 * digest, digest, draw=draw)
        for method in ("lare-bayes", "lare-rd")
        for draw, digest in enumerate("ab")
    ]
    assert differing(draws) == []
    another = [
        of(method, 8 * digest, f"more{digest}", draw=1) for method, digest in (("lare-bayes", "c"), ("lare-rd", "d"))
    ]
    assert differing([recorded, own, *another])[1:] == ["phi on Chase (cccccccc: lare-bayes; dddddddd: lare-rd)"]
    assert differing([recorded, of("llm-reward", 8 * "b", 3)]) == []
    assert differing([recorded, of("lare-bayes", 8 * "b", 4)]) == []  # rows of their own, named after them


def test_runs_whose_step_sizes_fall_over_other_numbers_of_steps_are_told_apart(made):
    short = made("a", [1.0], algorithm="ppo", rollout_steps=50)
    settings = short.config.settings.model_copy(update={"steps": 500})
    config = short.config.model_copy(update={"settings": settings})
    longer = Run(short.directory, config, ())
    assert list(by_label([short, longer])) == ["dense, steps 100", "dense, steps 500"]
    assert differing([short, longer]) == ["steps (100: dense; 500: dense)"]


def test_several_versions_and_machines_are_named(made):
    warmup = {"td3": {"warmup": 10}}
    one, other = made("a", [1.0], **warmup), made("b", [2.0], method="rd", **warmup)
    assert find_all([one.directory, other.directory], RETURN)[1] == []
    config = other.directory / "config.json"
    config.write_text(config.read_text().replace(other.config.lare, "0.2.0 (0123456789)"))
    jax, machine = one.config.versions["jax"], one.config.machine
    config.write_text(config.read_text().replace(f'"{jax}"', f'"9.{jax}"').replace(", cpu", ", gpu"))
    assert find_all([one.directory, other.directory], RETURN)[1] == [
        f"the runs were trained by several versions of LaRe ({one.config.lare}: dense; 0.2.0 (0123456789): rd)",
        f"the runs were trained with several versions of JAX ({jax}: dense; 9.{jax}: rd)",
        f"the runs were trained on several machines ({machine}: dense; {machine.replace('cpu', 'gpu')}: rd)",
    ]


def test_another_metric(made):
    run = made("a", [1.0, 3.0])
    with pytest.raises(LareError) as error:
        grouped(by_label([run]), "evaluation/returns")
    assert str(error.value) == (
        f"{run.directory} has no metric 'evaluation/returns' (did you mean 'evaluation/return'?); it has critic/loss, "
        "evaluation/return. Leave it out, or compare another metric"
    )
    runs = [made("b", [1.0], "Walker2d-v4"), made("b", [1.0], "Reacher-v4")]
    for lines in (one.directory / "metrics.jsonl" for one in runs):
        lines.write_text(lines.read_text().replace("evaluation/return", "credit/error"))
    with pytest.raises(LareError) as error:
        grouped(by_label(runs), "credit/error")
    assert str(error.value) == (
        "only evaluation/return can be compared over several tasks: compare credit/error on each task by itself"
    )
