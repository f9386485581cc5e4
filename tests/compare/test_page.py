import json
from dataclasses import replace

import numpy as np
import pytest

from lare_rl.compare.collect import collect_results, select_runs
from lare_rl.compare.comparison import compare
from lare_rl.compare.labels import label_runs
from lare_rl.compare.messages import MESSAGES, find_min_p, find_small_samples, to_text
from lare_rl.compare.metric_tables import read_metric_rows, write_table
from lare_rl.compare.page import comparison_table, describe, write_comparisons
from lare_rl.compare.results import read_run_results
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.runs.metric_names import RETURN


def read(runs):
    return read_run_results(label_runs(runs), RETURN)


def codes(findings):
    return [finding.code for finding in findings]


def test_page_of_several_tasks(make_run, tmp_path):
    low, high = [1.0, 2, 3], [4.0, 5, 6]
    runs = [
        make_run(name, values, task, method=method)
        for task in ("Chase", "Depot")
        for name, values, method in (("a", low, "dense"), ("b", high, "rd"))
    ]
    _, overall = write_comparisons(read(runs), tmp_path / "page.html")
    assert overall == [("dense (baseline)", "3", "-", "-"), ("rd", "3", "1.000", "0.005")]
    page, config = (tmp_path / "page.html").read_text(), runs[0].config
    assert page.count("<svg") == 4
    facts = (f"LaRe {config.lare}", f"JAX {config.versions['jax']}", config.machine, "episodes of an evaluation 10")
    assert all(fact in page for fact in facts)


def test_command(make_run, command, tmp_path):
    runs = make_run("a", [1.0, 3.0]), make_run("b", [2.0, 4.0], method="rd"), make_run("c", [7.0], "Depot", method="rd")
    paths = [run.directory for run in runs]
    status, out, _ = command("compare", *paths)
    assert status == 0
    assert MESSAGES["no_overall_table"] in out
    status, out, _ = command("compare", *paths[:2], "--at", 50, "--late", "--out", tmp_path / "late.html")
    assert status == 0
    assert "three quarters of 50 steps" in out
    assert "three quarters of 50 steps" in (tmp_path / "late.html").read_text()
    config = runs[0].directory / "config.json"
    for out, content in ((".", "not the name of a file"), (config, "is no page")):
        status, _, error = command("compare", *paths, "--out", out)
        assert (status, error.count("\n"), content in error) == (2, 1, True)
    assert config.read_text().startswith("{")
    table = tmp_path / "table.csv"
    table.write_text(text := "method,task,seed,step,evaluation/return\nother,Chase,0,100,1\n")
    assert (command("compare", table, "--out", table)[0], table.read_text()) == (2, text)


def test_outputs_of_a_sweep_among_its_runs(make_run, command, tmp_path):
    """DIRECTORY/* has the tables and the pages of LaRe, too."""
    runs = [make_run("a", [1.0, 3.0]), make_run("b", [2.0, 4.0], method="rd")]
    write_table(read_metric_rows([run.directory for run in runs]), tmp_path / "results")
    (tmp_path / "compare.html").touch()
    outputs = sorted(path for path in tmp_path.iterdir() if path.is_file())
    assert {path.name for path in outputs} >= {"results.csv", "compare.html"}
    results, _ = collect_results([tmp_path / "runs", *outputs])
    assert results == read(runs)
    assert len(collect_results([tmp_path / "results.csv"])[0]) == 4
    assert len(collect_results([tmp_path / "results.csv", tmp_path / "compare.html"])[0]) == 4
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "results.csv").rename(tmp_path / "elsewhere" / "results.csv")
    assert len(collect_results([runs[0].directory, tmp_path / "elsewhere" / "results.csv"])[0]) > 2


def test_comparison_table(make_run):
    single = compare(read([make_run("a", [-347.3176]), make_run("b", [2.0], method="rd")]))
    assert comparison_table(single)[1] == [
        ("dense (baseline)", "1", "-347.3", "-347.3", "-", "-", "-"),
        ("rd", "1", "2.000", "2.000", "-", "-", "-"),
    ]
    assert codes(find_small_samples(single)) == []
    runs = [make_run(f"draw{draw}", [draw, draw + 100.0], method="lare-rrdu", draw=draw) for draw in range(3)]
    header, (row,) = comparison_table(compare(read(runs)))
    assert dict(zip(header, row, strict=True))["draws"] == "3"
    assert "draws" not in comparison_table(compare(read(runs[:1])))[0]


def test_smallest_p(make_run):
    """Two seeds above two others, or below them: two of the six ways to deal four numbers."""
    runs = [make_run("a", [1.0, 2.0]), make_run("b", [3.0, 4.0], method="rd"), make_run("c", [0.0, 0.5], method="rrdu")]
    comparison = compare(read(runs))
    _, better, worse = comparison.rows
    assert (str(better.probability_of_improvement), better.p_value) == ("1.000", pytest.approx(1 / 3))
    assert (str(worse.probability_of_improvement), worse.p_value) == ("0.000", pytest.approx(1 / 3))
    header, rows = comparison_table(comparison)
    assert (header[-1], rows[1][-1]) == ("p", "0.33")
    (finding,) = find_min_p(comparison)
    assert finding.values["p"] == pytest.approx(1 / 3)
    assert describe(comparison).endswith("p is at least 0.33.")
    many = [make_run("d", [1.0, 2, 3, 4]), make_run("e", [1.0, 2, 3, 4], method="rd")]
    assert codes(find_min_p(compare(read(many)))) == []


@pytest.mark.parametrize(
    ("draws", "expected"),
    [
        ([[1.0, 2.0, 6.0]], [("few_values", "seeds", 3, 0.75)]),
        ([[1.0] * 4] * 2, [("few_values", "draws", 2, 0.5)]),
        ([[1.0]], []),
    ],
)
def test_small_samples(draws, expected, make_run):
    runs = [make_run(f"draw{draw}", returns, method="lare-rd", draw=draw) for draw, returns in enumerate(draws)]
    comparison = compare(read(runs))
    findings = list(find_small_samples(comparison))
    assert [(finding.code, *map(finding.values.get, ("noun", "count", "coverage"))) for finding in findings] == expected
    assert to_text(findings) in describe(comparison)


def test_select_runs(make_run):
    finished, unfinished, empty = (
        make_run(name, [1.0], method=method, steps=steps, td3={"warmup": 10})
        for name, method, steps in (("a", "dense", (50, 100)), ("b", "rd", (25, 50)), ("c", "dense", ()))
    )
    selected, findings = select_runs([finished, unfinished, empty])
    assert [run.directory for run in selected] == [finished.directory, unfinished.directory]
    assert codes(findings) == ["unfinished", "no_evaluation"]
    assert "50 of 100" in to_text(findings)
    with pytest.raises(LareError, match="Chase/c: no run has an evaluation"):
        select_runs([empty])


def test_select_runs_with_metric(make_run):
    with_error, without = (make_run(method, [1.0], method=method, td3={"warmup": 10}) for method in ("dense", "rd"))

    def write(run, error):
        lines = [line | {"credit/error": error, "evaluation/summed_return": 1.0} for line in run.metrics()]
        (run.directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))

    write(with_error, np.pi)
    selected, findings = select_runs([with_error, without], "credit/error")
    assert (selected, codes(findings)) == ([with_error], ["no_metric"])
    assert codes(select_runs([with_error])[1]) == ["mean_over_agents"]
    teams = read_task("CompetitivePP-6")
    (finding,) = select_runs([replace(without, config=without.config.model_copy(update={"task": teams}))])[1]
    assert finding.values["teams"] == ("evaluation/return_predator", "evaluation/return_prey")
    with pytest.raises(LareError, match="'credit/error'; they have critic/loss, evaluation/return"):
        select_runs([without], "credit/error")
    write(without, None)
    with pytest.raises(LareError, match="credit/error yet: it is null"):
        select_runs([without], "credit/error")
