import re
from pathlib import Path

import pytest

from helpers.long_tests import long_case
from helpers.untrained_runs import invent_training
from lare_rl.cli import studies
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError
from lare_rl.llm.recording import shipped_recordings
from lare_rl.runs.metric_names import CREDIT_ERROR, RETURN, SUMMED_RETURN
from lare_rl.sweep import processes
from lare_rl.sweep.jobs import check_job
from lare_rl.sweep.resources import Resources
from paper.exhibits import LARE_SOURCE, exhibit_jobs, exhibits
from paper.reproduce import REAL, UNTRAINED, listed, reproduce
from paper.trained import MEANING, TRAVELLED, WON, verdict

EXHIBITS = exhibits()
NAMES = [name for name, _, _ in listed()]
FAST = ("algorithms", "starcraft", "triangle-area")
"""Exhibits with several panels, with two measures, and with a number of steps that differs from the paper's."""


def all_jobs(exhibit, budget, root):
    jobs = exhibit_jobs(exhibit, budget, root)
    return [job for task_jobs in jobs.values() for contender_jobs in task_jobs.values() for job in contender_jobs]


def train_with_score(score):
    """Invent training whose runs have a score of settings and seed, and a tenth of it as the error."""

    def find_metrics(job, seed):
        value = float(score(job.resolved, seed))
        scores = dict.fromkeys((RETURN, SUMMED_RETURN, TRAVELLED, WON), value)
        return scores | {CREDIT_ERROR: 0.1 * value, "credit/correlation": 0.5}

    return invent_training(find_metrics)


@pytest.fixture
def invented_runs(monkeypatch):
    """The score of a run is its method's number in the table of methods."""
    train = train_with_score(lambda settings, _: list(METHODS).index(settings.method))
    monkeypatch.setattr(processes, "train_in_process", train)


@pytest.fixture
def make_page(tmp_path):
    return lambda name, budget="smoke": reproduce(name, budget, Resources(), tmp_path / "runs", tmp_path / "out")


def test_exhibits_are_consistent():
    for exhibit in EXHIBITS.values():
        labels = set(exhibit.contenders)
        assert {name for claim in exhibit.claims for name in (claim.better, *claim.than)} <= labels
        assert exhibit.measure in MEANING
        assert {*exhibit.printed, *exhibit.laptop} <= set(exhibit.tasks)
        assert all(set(figures) <= labels for figures in exhibit.printed.values())
    labels, claim = EXHIBITS["algorithms"].contenders, EXHIBITS["algorithms"].claims[-1]
    assert [*labels][:5] == [f"{name}, td3" for name in ("dense", "episodic", "RRD-unbiased", "LaRe-RRDu")] + [
        "dense, sac"
    ]
    assert (claim.better, claim.than, claim.at_least) == ("LaRe-RRDu, ppo", ("dense, ppo",), True)


@pytest.mark.parametrize("budget", ["smoke", long_case("laptop"), long_case("paper")])
def test_exhibit_jobs(budget):
    """Settings are valid, recordings exist, runs that share a directory have equal settings, and so have runs in the repository."""
    settings, root = {}, Path(__file__).parents[3] / "benchmarks" / "results" / "reproduce" / budget
    for exhibit in EXHIBITS.values():
        for job in all_jobs(exhibit, budget, root):
            assert settings.setdefault(job.directory, job.resolved) == job.resolved
            if budget == "laptop":
                check_job(job)
                assert job.done == job.started
            method = METHODS[job.resolved.method]
            if method.needs_phi:
                recordings = {recording.task for recording in shipped_recordings(method.phi_kind, job.resolved.draw)}
                # A task that is like another one has the same prompts.
                names = {re.sub("Sparse|Target|Threshold|Saturating|Foot", "", role.name) for role in job.task.roles}
                assert names <= recordings


@pytest.mark.usefixtures("invented_runs")
@pytest.mark.parametrize("name", [name if name in FAST else long_case(name) for name in EXHIBITS])
def test_exhibit_page(name, make_page):
    exhibit, page = EXHIBITS[name], make_page(name)
    text = page.read_text()
    origin = "Not in the paper" if exhibit.source == LARE_SOURCE else f"The paper's {exhibit.source}"
    assert text.startswith(f"# {exhibit.title}\n\n{origin}, by `lare-rl reproduce {name} --budget smoke`.")
    assert "it runs, and learns nothing.**" in text
    assert all(f"| {label} |" in text for label in exhibit.contenders)
    assert all(f"* {difference}" in text for difference in exhibit.differences)
    assert f"]({name}-{exhibit.tasks[0]}.svg)" in text
    assert (page.parent / f"{name}-{exhibit.tasks[0]}.svg").read_text().startswith("<svg")
    assert (page.parent / f"{name}.csv").read_text().startswith("task,run,method,")
    if name == "triangle-area":
        assert "* Environment steps: 600 (the paper: 2,050,000)." in text


def test_draws_are_compared_if_there_are_several(make_page, monkeypatch):
    """Three draws that differ much decide nothing, however many seeds agree."""
    train = train_with_score(lambda settings, seed: settings.draw * 1000 + settings.candidates + seed)
    monkeypatch.setattr(processes, "train_in_process", train)
    page = make_page("candidates", "laptop")
    assert "| n = 5 is at least as good as n = 1 | 6 of 9 |" in page.read_text()
    assert "| not refuted |" in page.read_text()
    rows = page.with_suffix(".csv").read_text().splitlines()
    assert len({tuple(row.split(",")[:8]) for row in rows[1:]}) == len(rows) - 1 == 2 * 3 * 3 * 2


@pytest.mark.parametrize(
    ("chance", "contrary", "everywhere", "at_least", "words"),
    [
        (0.025, 1.0, True, False, "yes"),
        (0.025, 1.0, False, False, "not on every task"),
        (0.05, 1.0, True, False, "open"),
        (0.5, 0.5, True, True, "not refuted"),
        (1.0, 0.02, False, True, "the other way round"),
    ],
)
def test_verdict(chance, contrary, everywhere, at_least, words):
    assert verdict(chance, contrary, everywhere, at_least) == words


@pytest.mark.usefixtures("invented_runs")
def test_finished_runs_and_remarks_are_kept(make_page, monkeypatch):
    page = make_page("bottleneck")
    page.write_text(page.read_text() + "\n## Remarks\n\nNothing was learned.\n")
    text, trained = page.read_text(), []
    monkeypatch.setattr(processes, "train_in_process", lambda job, *_: trained.append(job.name) or "no")
    assert make_page("bottleneck").read_text() == text
    assert trained == []
    with pytest.raises(LareError, match=r"^1 of 3 runs failed, so there is no page: Reacher-v4/rd-td3$"):
        make_page("errors")
    assert trained == ["Reacher-v4/rd-td3"]


def test_all_exhibits_continue_after_a_failure(command, monkeypatch):
    def fail_reproduce(name, *_):
        if name == "errors":
            raise LareError("no luck")
        return Path(name)

    monkeypatch.setattr("paper.reproduce.reproduce", fail_reproduce)
    status, out, err = command("reproduce", "all", "--budget", "smoke")
    assert status == 1
    names = [name for name in NAMES if not name.startswith(REAL)]
    assert out.split() == [word for name in names if name != "errors" for word in ("wrote", name)]
    assert err == f"errors: no luck\n1 of {len(names)} exhibits have no page\n"


def test_reproduce_mistakes(command, monkeypatch, tmp_path):
    assert all(name in command("reproduce")[1] for name in (*EXHIBITS, *UNTRAINED))
    status, _, err = command("reproduce", "figure-9")
    assert (status, err) == (2, f"lare-rl: no exhibit 'figure-9'; the exhibits are {', '.join(NAMES)}\n")
    monkeypatch.setattr(studies, "_BENCHMARKS", tmp_path)
    status, _, err = command("reproduce")
    assert (status, "checkout" in err, "pip install" in err) == (2, True, True)
