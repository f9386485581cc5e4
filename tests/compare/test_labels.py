from pathlib import Path

import pytest

from lare_rl.compare.collect import collect_results
from lare_rl.compare.labels import find_differences, find_origin_differences, label_runs
from lare_rl.compare.messages import to_text
from lare_rl.runs.directory import Run, open_without_functions


def change_run(run, **changes):
    return Run(run.directory, run.config.model_copy(update=changes), ())


def texts(differences):
    return [str(difference) for difference in differences]


def sizes(runs):
    return {label: len(group) for label, group in label_runs(runs).items()}


def test_task_defaults_do_not_split_labels():
    """Reacher-v4 scores the observation before a step, Walker2d-v4 the one after it."""
    root = Path(__file__).parents[2] / "benchmarks" / "results" / "reproduce" / "laptop"
    methods = ("dense-td3", "rrdu-td3", "lare-rrdu-td3-draw0")
    runs = [
        open_without_functions(root / task / method) for method in methods for task in ("Reacher-v4", "Walker2d-v4")
    ]
    assert list(label_runs(runs)) == ["dense", "rrdu", "lare-rrdu"]


RD, SLOW = {"method": "rd"}, {"method": "rd", "credit": {"learning_rate": 1e-4}}
SHORT, LONG = {"td3": {"warmup": 10}}, {"td3": {"warmup": 20}}
LARE_RD, AFTER = {"method": "lare-rd"}, {"scored_observation": "after"}


@pytest.mark.parametrize(
    ("runs", "expected"),
    [
        # Settings, and algorithms.
        (
            [("a", "Chase", RD), ("b", "Chase", SLOW), ("c", "Chase", {})],
            {"rd, credit.learning_rate 0.0003": 1, "rd, credit.learning_rate 0.0001": 1, "dense": 1},
        ),
        ([("a", "Chase", {}), ("b", "Chase", {"algorithm": "ddpg"})], {"dense, td3": 1, "dense, ddpg": 1}),
        # Differences between tasks split no label, unless there is also one on a single task.
        ([("a", "Chase", SHORT), ("a", "Depot", LONG)], {"dense": 2}),
        (
            [("a", "Chase", SHORT), ("a", "Depot", LONG), ("b", "Chase", LONG)],
            {"dense, td3.warmup 10": 1, "dense, td3.warmup 20": 2},
        ),
        ([("c", "Chase", {"algorithm": "td3"}), ("c", "Depot", {"algorithm": "ddpg"})], {"dense": 2}),
        # Directories, if two runs have a seed in common. Runs of other seeds are more seeds of the same label.
        ([("old", "Chase", {}), ("more", "Chase", {"seed": 1})], {"dense": 2}),
        (
            [("old", "Chase", {}), ("new", "Chase", {"evaluation_episodes": 3}), ("more", "Chase", {"seed": 1})],
            {"dense, old": 1, "dense, new": 1, "dense, more": 1},
        ),
        ([("old", "Chase", {}), ("old", "Reacher-v4", {})], {"dense": 2}),
        ([("one/dense", "Chase", {}), ("two/dense", "Chase", {})], {"dense, one": 1, "dense, two": 1}),
        # Settings without effect split no label.
        (
            [("a", "Chase", LARE_RD), ("b", "Chase", LARE_RD | {"scored_observation": "before", "seed": 1})],
            {"lare-rd": 2},
        ),
        (
            [("a", "Chase", {}), ("b", "Chase", AFTER | {"credit": {"hidden": (8,)}, "draw": 3, "seed": 1})],
            {"dense": 2},
        ),
        ([("a", "Chase", LARE_RD | AFTER), ("b", "Chase", {})], {"lare-rd": 1, "dense": 1}),
    ],
)
def test_split_labels(runs, expected, make_run):
    made_runs = [make_run(name, [1.0], task, **settings) for name, task, settings in runs]
    assert list(sizes(made_runs).items()) == list(expected.items())


def test_functions_split_labels(make_run):
    """But not if each draw of the language model has its own function."""
    a, b = ("0123456789abcdef",), ("fedcba9876543210",)
    first, second = make_run("a", [1.0], method="lare-rd"), make_run("b", [2.0], method="lare-rd", seed=1)
    runs = [change_run(first, function_sha256=a), change_run(second, function_sha256=b), make_run("c", [3.0])]
    assert list(label_runs(runs)) == ["lare-rd, phi 01234567", "lare-rd, phi fedcba98", "dense"]
    runs[1] = change_run(second, function_sha256=a)
    assert sizes(runs[:2]) == {"lare-rd": 2}
    runs[1] = change_run(make_run("d", [2.0], method="lare-rd", draw=1), function_sha256=b)
    assert sizes(runs[:2]) == {"lare-rd": 2}


def test_find_differences(make_run):
    settings = [{"td3": {"warmup": 10}}, {"td3": {"warmup": 20}, "method": "rd"}, {"algorithm": "ddpg"}]
    runs = [make_run(str(number), [1.0], **values) for number, values in enumerate(settings)]
    assert texts(find_differences(runs)) == ["td3.warmup (10: dense; 20: rd)"]
    assert find_differences(runs[1:]) == []
    (finding,) = collect_results([run.directory for run in runs[:2]])[1]
    assert "td3.warmup (10: dense; 20: rd)" in to_text([finding])
    (origin,) = find_origin_differences([runs[0], change_run(runs[1], versions={})])
    assert "unknown: rd" in str(origin)


def test_find_function_differences(make_run):
    def run(method, digest, name, **settings):
        return change_run(make_run(name, [1.0], method=method, **settings), function_sha256=(8 * digest,))

    recorded, custom = run("lare-bayes", "a", "0"), run("lare-rd", "b", "1")
    assert texts(find_differences([recorded, custom])) == ["phi on Chase (aaaaaaaa: lare-bayes; bbbbbbbb: lare-rd)"]
    assert find_differences([recorded, run("lare-rd", "a", "2"), make_run("dense", [1.0])]) == []
    methods = ("lare-bayes", "lare-rd")
    draws = [run(method, "ab"[draw], f"{method}{draw}", draw=draw) for method in methods for draw in (0, 1)]
    assert find_differences(draws) == []
    second_draws = [run(method, digest, digest, draw=1) for method, digest in zip(methods, "cd", strict=True)]
    assert texts(find_differences([recorded, custom, *second_draws]))[1:] == [
        "phi on Chase (cccccccc: lare-bayes; dddddddd: lare-rd)"
    ]
    assert find_differences([recorded, run("llm-reward", "b", "3")]) == []
    assert find_differences([recorded, run("lare-bayes", "b", "4")]) == []  # two labels
