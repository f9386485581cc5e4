import pytest

from helpers.untrained_runs import invent_training
from lare_rl.errors import LareError
from lare_rl.runs.metric_names import RETURN
from lare_rl.sweep import processes
from lare_rl.sweep.resources import Resources
from paper import real
from paper.reproduce import reproduce

STUDY = real.read_study()
LABELS = [label for label, method in STUDY.methods.items() if "jobshop" in method.tasks]


def test_page(monkeypatch, tmp_path):
    pytest.importorskip("jumanji")
    train = invent_training(lambda job, seed: {RETURN: float(len(job.directory.name))})
    monkeypatch.setattr(processes, "train_in_process", train)
    page = reproduce("real-jobshop", "smoke", Resources(), tmp_path / "runs", tmp_path / "out")
    text = page.read_text()
    assert text.startswith(f"# {real.TITLE}\n\nBy `lare-rl reproduce real-jobshop --budget smoke`. Seeds: 1. LaRe ")
    assert ", jumanji 1" in text
    assert all(f"| {label} | " in text for label in (*LABELS, "random", "rule: most work remaining"))
    assert "it runs, and learns nothing" in text
    assert (page.parent / "real-jobshop.svg").is_file()


def test_plan(tmp_path):
    pytest.importorskip("jumanji")
    jobs = real.plan_jobs("laptop", tmp_path, ["jobshop"])["jobshop"]
    assert list(jobs) == LABELS != list(STUDY.methods)
    assert [list(job.resolved.all_seeds) for job in jobs["LaRe, closed form"]] == [list(range(5)), list(range(5, 10))]
    assert len({job.directory for group in jobs.values() for job in group}) == 2 * len(jobs)
    (dense, _), (published, _) = jobs["dense proxy"], jobs["LaRe as published"]
    assert (dense.task.name, dense.task.evaluation_environment) == ("JobShopProxy", "final_score:JobShopTest-v0")
    assert not published.resolved.credit.normalise  # and the task scores the observation before the step anyway


def test_missing_package(monkeypatch, tmp_path):
    monkeypatch.setattr(real, "find_spec", lambda name: None)
    with pytest.raises(LareError, match="pip install -e 'benchmarks/real"):
        real.plan_jobs("smoke", tmp_path, list(STUDY.tasks))
