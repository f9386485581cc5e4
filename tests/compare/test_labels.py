from dataclasses import replace
from functools import partial
from pathlib import Path, PureWindowsPath
from types import SimpleNamespace

from helpers.toy_envs import toy_spec
from lare_rl.compare.collect import collect_results
from lare_rl.compare.labels import find_differences, label_runs
from lare_rl.compare.messages import to_text
from lare_rl.compare.scores import group_results
from lare_rl.runs.directory import Run


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
    results, _ = collect_results([root / task / method for method in methods for task in ("Reacher-v4", "Walker2d-v4")])
    groups = group_results(results)
    assert [group.label for group in groups] == ["dense", "rrdu", "lare-rrdu"]
    assert groups[0].tasks == ("Reacher-v4", "Walker2d-v4")


def test_settings_and_algorithms_split_labels(make_run):
    slow = {"credit": {"learning_rate": 1e-4}}
    runs = [make_run("a", [1.0], method="rd"), make_run("b", [2.0], method="rd", **slow), make_run("c", [3.0])]
    assert list(label_runs(runs)) == ["rd, credit.learning_rate 0.0003", "rd, credit.learning_rate 0.0001", "dense"]
    runs.append(make_run("d", [3.0], algorithm="ddpg"))
    assert list(label_runs(runs))[1:] == ["rd, td3, credit.learning_rate 0.0001", "dense, td3", "dense, ddpg"]


def test_differences_between_tasks_do_not_split_labels(make_run):
    """Unless there is also a difference on one task."""
    runs = [make_run("a", [1.0], td3={"warmup": 10}), make_run("a", [2.0], "Depot", td3={"warmup": 20})]
    assert sizes(runs) == {"dense": 2}
    runs.append(make_run("b", [3.0], td3={"warmup": 20}))
    assert sizes(runs) == {"dense, td3.warmup 10": 1, "dense, td3.warmup 20": 2}
    runs = [make_run("c", [1.0], algorithm="td3"), make_run("c", [2.0], "Depot", algorithm="ddpg")]
    assert sizes(runs) == {"dense": 2}


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


def test_directories_split_labels(make_run):
    """If two runs have a seed in common. Runs of other seeds are more seeds of the same label."""
    old, new = make_run("old", [1.0]), make_run("new", [2.0], evaluation_episodes=3)
    more = make_run("more", [3.0], seed=1)
    assert sizes([old, more]) == {"dense": 2}
    assert list(label_runs([old, new, more])) == ["dense, old", "dense, new", "dense, more"]
    assert sizes([old, make_run("old", [1.0], "Reacher-v4")]) == {"dense": 2}
    sweeps = [make_run(f"{sweep}/dense-td3", [1.0]) for sweep in ("one", "two")]
    assert list(label_runs(sweeps)) == ["dense, one", "dense, two"]


def test_directories_on_two_drives(make_run):
    runs = []
    for drive in "CD":
        directory = SimpleNamespace(resolve=partial(PureWindowsPath, f"{drive}:/runs/new"))
        runs.append(replace(make_run(drive, [1.0]), directory=directory))
    assert list(label_runs(runs)) == ["dense, C:", "dense, D:"]


def test_settings_without_effect_do_not_split_labels(make_run):
    default = {"scored_observation": toy_spec().scored_observation, "seed": 1}
    runs = [make_run("a", [1.0], method="lare-rd"), make_run("b", [2.0], method="lare-rd", **default)]
    assert sizes(runs) == {"lare-rd": 2}
    unused = {"scored_observation": "after", "credit": {"hidden": (8,)}, "draw": 3, "seed": 1}
    runs = [make_run("c", [1.0]), make_run("d", [2.0], **unused)]
    assert sizes(runs) == {"dense": 2}
    runs = [make_run("e", [1.0], method="lare-rd", scored_observation="after"), runs[0]]
    assert list(label_runs(runs)) == ["lare-rd", "dense"]


def test_find_differences(make_run):
    settings = [{"td3": {"warmup": 10}}, {"td3": {"warmup": 20}, "method": "rd"}, {"algorithm": "ddpg"}]
    runs = [make_run(str(number), [1.0], **values) for number, values in enumerate(settings)]
    assert texts(find_differences(runs)) == ["td3.warmup (10: dense; 20: rd)"]
    assert find_differences(runs[1:]) == []
    (finding,) = collect_results([run.directory for run in runs[:2]])[1]
    assert "td3.warmup (10: dense; 20: rd)" in to_text([finding])


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
