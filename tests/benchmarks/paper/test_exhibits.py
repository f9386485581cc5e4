"""The table of exhibits holds together, and each of them becomes a page: runs that are made up, and some that are trained."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from helpers.listeners import AtStep
from lare_rl.cli import studies
from lare_rl.compare import bootstrap
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError
from lare_rl.llm.recording import shipped_recordings
from lare_rl.runs.config_file import make_config
from lare_rl.runs.metric_names import CREDIT_ERROR, RETURN, SUMMED_RETURN
from lare_rl.sweep import processes
from lare_rl.sweep.jobs import check_job, job_to_json, train_job
from lare_rl.sweep.sweep import Resources
from lare_rl.training import train as training
from paper.exhibits import LARE_SOURCE, Exhibit, budgets, exhibit_jobs, exhibits
from paper.reproduce import UNTRAINED, listed, reproduce
from paper.trained import MEANING, TRAVELLED, WON, verdict

EXHIBITS = exhibits()
BUDGETS = tuple(budgets())
NAMES = [name for name, _, _ in listed()]
each_exhibit = pytest.mark.parametrize("exhibit", EXHIBITS.values(), ids=EXHIBITS)
each_budget = pytest.mark.parametrize("budget", BUDGETS)


@pytest.fixture(autouse=True)
def few_repetitions(monkeypatch):
    monkeypatch.setattr(bootstrap, "REPETITIONS", 50)


def write_run(value):
    """Instead of training: metrics with a return and an error made up from settings and seed."""

    def train(job, cores, running):
        job.directory.mkdir(parents=True)
        (job.directory / "config.json").write_text(make_config(job.task, job.resolved, ()).model_dump_json())
        lines = []
        for step in (job.resolved.steps // 2, job.resolved.steps):
            for seed in job.resolved.all_seeds:
                score = float(value(job.resolved, seed))
                measured = dict.fromkeys((RETURN, SUMMED_RETURN, TRAVELLED, WON), score) | {CREDIT_ERROR: 0.1 * score}
                lines.append({"step": step, "seed": seed, **measured, "credit/correlation": 0.5})
        (job.directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))

    return train


@pytest.fixture
def made_up(monkeypatch):
    """Each method has a return of its own, its place in the table of methods."""
    monkeypatch.setattr(
        processes, "train_in_process", write_run(lambda settings, _: list(METHODS).index(settings.method))
    )


@each_exhibit
def test_what_is_claimed_and_printed_is_of_contenders_that_are_there(exhibit):
    labels = exhibit.contenders
    assert {name for claim in exhibit.claims for name in (claim.better, *claim.than)} <= set(labels)
    assert exhibit.measure in MEANING
    assert set(exhibit.printed) <= set(exhibit.tasks)
    assert all(set(figures) <= set(labels) for figures in exhibit.printed.values())
    assert set(exhibit.laptop) <= set(exhibit.tasks)


@each_budget
@each_exhibit
def test_every_run_of_an_exhibit_could_be_trained(exhibit, budget):
    """Settings that go together, and recordings that are there."""
    for task_jobs in exhibit_jobs(exhibit, budget, Path("runs")).values():
        for job in (job for contender_jobs in task_jobs.values() for job in contender_jobs):
            method = METHODS[job.resolved.method]
            if method.needs_phi:
                recorded = {recording.task for recording in shipped_recordings(method.phi_kind, job.resolved.draw)}
                # A task that is like another one has the same prompts.
                assert {
                    re.sub("Sparse|Target|Threshold|Saturating|Foot", "", role.name) for role in job.task.roles
                } <= recorded


@each_exhibit
def test_runs_that_are_kept_are_taken_for_trained(exhibit):
    results = Path(__file__).parents[3] / "benchmarks" / "results" / "reproduce" / "laptop"
    for task_jobs in exhibit_jobs(exhibit, "laptop", results).values():
        for job in (job for contender_jobs in task_jobs.values() for job in contender_jobs):
            check_job(job)
            assert job.done == job.started


@pytest.mark.parametrize("name", EXHIBITS)
def test_every_exhibit_becomes_a_page(name, made_up, tmp_path):
    exhibit = EXHIBITS[name]
    page = reproduce(name, "smoke", Resources(), tmp_path / "runs", tmp_path / "out")
    text = page.read_text()
    origin = "Not in the paper" if exhibit.source == LARE_SOURCE else f"The paper's {exhibit.source}"
    assert text.startswith(f"# {exhibit.title}\n\n{origin}, by `lare-rl reproduce {name} --budget smoke`.")
    assert all(f"| {label} |" in text for label in exhibit.contenders)
    assert all(f"* {difference}" in text for difference in exhibit.differences)
    for task in exhibit.tasks[:1]:
        assert f"]({name}-{task}.svg)" in text
        assert (page.parent / f"{name}-{task}.svg").read_text().startswith("<svg")
    assert (page.parent / f"{name}.csv").read_text().startswith("task,run,method,")


def test_figures_claims_and_verdicts(made_up, tmp_path):
    """With three seeds on two tasks: errors are the place in the table of methods, a tenth of it; more is worse."""
    text = reproduce("errors", "laptop", Resources(), tmp_path / "runs", tmp_path / "out").read_text()
    ranks = {label: list(METHODS).index(name) / 10 for label, name in (("RD", "rd"), ("LaRe-RRDu", "lare-rrdu"))}
    assert "50,000 environment steps, seeds 0 to 2, draw 0 of the language model." in text
    assert f"| RD | {ranks['RD']:.4f} |" in text
    assert "| 0.7 ± 0.5 |" in text
    assert ranks["RD"] < ranks["LaRe-RRDu"]
    assert "| LaRe-RRDu errs less than RD | 0 of 9 | 0 of 9 | 1.000 | the other way round |" in text


def test_draws_are_what_is_compared_where_there_are_several(tmp_path, monkeypatch):
    """Seeds differ by next to nothing, draws by much: three draws do not settle anything, however many seeds agree."""
    monkeypatch.setattr(
        processes,
        "train_in_process",
        write_run(lambda settings, seed: settings.draw * 1000 + settings.candidates + seed),
    )
    text = reproduce("candidates", "laptop", Resources(), tmp_path / "runs", tmp_path / "out").read_text()
    assert "| n = 5 is at least as good as n = 1 | 6 of 9 |" in text
    assert "| not refuted |" in text
    rows = (tmp_path / "out" / "laptop" / "candidates.csv").read_text().splitlines()
    assert len({tuple(row.split(",")[:8]) for row in rows[1:]}) == len(rows) - 1 == 2 * 3 * 3 * 2


@pytest.mark.parametrize(
    ("for_it", "against", "everywhere", "at_least", "said"),
    [
        (0.025, 1.0, True, False, "yes"),
        (0.025, 1.0, False, False, "not on every task"),
        (0.05, 1.0, True, False, "open"),
        (0.5, 0.5, True, False, "open"),
        (0.5, 0.5, True, True, "not refuted"),
        (1.0, 0.02, False, False, "the other way round"),
        (1.0, 0.02, False, True, "the other way round"),
    ],
)
def test_verdicts(for_it, against, everywhere, at_least, said):
    assert verdict(for_it, against, everywhere, at_least) == said


@each_budget
def test_no_two_contenders_share_a_run_by_chance(budget):
    """A directory is one run, whoever asks for it."""
    score = {}
    for exhibit in EXHIBITS.values():
        for task_jobs in exhibit_jobs(exhibit, budget, Path("runs")).values():
            for job in (job for contender_jobs in task_jobs.values() for job in contender_jobs):
                assert score.setdefault(job.directory, job.resolved) == job.resolved


def test_what_is_shared_or_done_is_not_trained_again(made_up, monkeypatch, tmp_path):
    reproduce("bottleneck", "smoke", Resources(), tmp_path / "runs", tmp_path / "out")
    trained = []
    monkeypatch.setattr(processes, "train_in_process", lambda job, *_: trained.append(job.name) or "no")
    reproduce("bottleneck", "smoke", Resources(), tmp_path / "runs", tmp_path / "out")
    assert trained == []
    with pytest.raises(LareError, match=r"^1 of 3 runs failed, so there is no page: Reacher-v4/rd-td3$"):
        reproduce("errors", "smoke", Resources(), tmp_path / "runs", tmp_path / "out")
    assert trained == ["Reacher-v4/rd-td3"]


def test_remarks_outlive_a_page(made_up, tmp_path):
    page = reproduce("sparse", "smoke", Resources(), tmp_path / "runs", tmp_path / "out")
    remarked = page.read_text() + "\n## Remarks\n\nNobody got anywhere.\n"
    page.write_text(remarked)
    assert reproduce("sparse", "smoke", Resources(), tmp_path / "runs", tmp_path / "out").read_text() == remarked


@pytest.mark.long
def test_an_exhibit_that_is_trained(command, monkeypatch, tmp_path):
    """The whole way, from the command line; the runs in this process, whose compiler is told to hurry."""
    monkeypatch.setattr(processes, "train_in_process", lambda job, cores, running: train_job(job_to_json(job)))
    monkeypatch.setattr(training, "Terminal", lambda: AtStep(-1, None))
    status, out, err = command("reproduce", "errors", "--budget", "smoke")
    assert (status, out) == (0, "wrote results/smoke/errors.md\n"), err
    assert err.splitlines()[-1].startswith("3 of 3: Reacher-v4/")
    assert (tmp_path / "runs" / "reproduce" / "smoke" / "Reacher-v4" / "rrdu-td3" / "checkpoint").is_dir()
    row = next(
        line for line in (tmp_path / "results" / "smoke" / "errors.md").read_text().splitlines() if "| RD |" in line
    )
    assert np.isfinite(float(row.split("|")[3].split("±")[0]))


def test_a_budget_that_teaches_nothing_says_so(made_up, tmp_path):
    text = reproduce("sparse", "smoke", Resources(), tmp_path / "runs", tmp_path / "out").read_text()
    assert "it runs, and learns nothing.**" in text
    text = reproduce("triangle-area", "smoke", Resources(), tmp_path / "runs", tmp_path / "out").read_text()
    assert "* Environment steps: 600 (the paper: 2,050,000)." in text


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda out: out.write_text(""), "nothing can be written into {out}/smoke: Not a directory"),
        (
            lambda out: (out / "smoke" / "sparse.csv").mkdir(parents=True),
            "nothing can be written into {out}/smoke: Is a directory",
        ),
    ],
)
def test_where_nothing_can_be_written_nothing_is_trained(prepare, message, monkeypatch, tmp_path):
    monkeypatch.setattr(processes, "train_in_process", lambda *_: pytest.fail("trained"))
    out = tmp_path / "out"
    prepare(out)
    with pytest.raises(LareError) as error:
        reproduce("sparse", "smoke", Resources(), tmp_path / "runs", out)
    assert str(error.value) == message.format(out=out)


def test_all_of_them_goes_on_after_one_that_fails(command, made_up, monkeypatch):
    def fail_reproduce(name, *_):
        if name == "errors":
            raise LareError("no luck")
        return Path(name)

    monkeypatch.setattr("paper.reproduce.reproduce", fail_reproduce)
    status, out, err = command("reproduce", "all", "--budget", "smoke")
    assert status == 2
    assert out.split() == [word for name in NAMES if name != "errors" for word in ("wrote", name)]
    assert err == f"errors: no luck\nlare-rl: 1 of {len(NAMES)} exhibits have no page\n"


def test_the_list(command):
    status, out, _ = command("reproduce")
    assert status == 0
    assert all(name in out for name in (*EXHIBITS, *UNTRAINED))


def test_an_exhibit_that_is_not_there(command):
    status, _, err = command("reproduce", "figure-9")
    assert status == 2
    assert err == f"lare-rl: no exhibit 'figure-9'; the exhibits are {', '.join(NAMES)}\n"


def test_without_a_checkout(command, monkeypatch, tmp_path):
    monkeypatch.setattr(studies, "_BENCHMARKS", tmp_path)
    status, _, err = command("reproduce")
    assert status == 2
    assert err.startswith("lare-rl: ")
    assert "checkout" in err
    assert "pip install" in err


def test_a_contender_for_each_algorithm():
    assert [*EXHIBITS["algorithms"].contenders][:5] == [
        "dense, td3",
        "episodic, td3",
        "RRD-unbiased, td3",
        "LaRe-RRDu, td3",
        "dense, sac",
    ]
    claim = EXHIBITS["algorithms"].claims[-1]
    assert (claim.better, claim.than, claim.at_least) == ("LaRe-RRDu, ppo", ("dense, ppo",), True)


def test_an_exhibit_of_which_something_is_missing():
    with pytest.raises(LareError, match=r"^the key 'tasks' is missing$"):
        Exhibit(title="none", source=LARE_SOURCE, contenders={"dense": "dense"}, claims=[])
