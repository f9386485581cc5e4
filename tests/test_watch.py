"""Bars of a sweep: what they show of runs that are to be, under way, and done."""

import io
import json
import threading

from rich.console import Console
from rich.progress import Progress

from helpers.toys import toy_spec
from lare_rl.cli import sweep_progress as watch
from lare_rl.config.resolve import decide
from lare_rl.config.settings import Settings
from lare_rl.sweep.jobs import Job


def job_at(directory, step):
    """A run that has come so far."""
    directory.mkdir(parents=True)
    if step:
        (directory / "config.json").write_text("{}")
        (directory / "metrics.jsonl").write_text(json.dumps({"step": step, "seed": 0}) + "\n")
    settings = Settings(method="dense", steps=100, evaluate_every=50)
    return Job(directory, toy_spec(), settings, decide(settings, toy_spec()))


def test_bars_follow_the_runs(monkeypatch, tmp_path):
    monkeypatch.setattr(watch, "EVERY", 0)
    waits, runs, ends = (job_at(tmp_path / "Chase" / name, step) for name, step in (("a", 0), ("b", 50), ("c", 50)))
    ended = threading.Event()

    def second_look():
        (ends.directory / "metrics.jsonl").write_text('{"step": 100, "seed": 0}\n')
        return False

    looks = iter([lambda: False, second_look, lambda: True])
    monkeypatch.setattr(ended, "is_set", lambda: next(looks)())
    bars = Progress(console=Console(file=io.StringIO()))
    watch.look([waits, runs, ends], bars, ended)
    assert [(bar.description, bar.completed, bar.total, bar.visible) for bar in bars.tasks] == [
        ("all runs", 150, 300, True),
        ("Chase/b", 50, 100, True),
        ("Chase/c", 100, 100, False),
    ]


def test_nobody_is_looking(capsys):
    with watch.watching([]) as said:
        said("1 of 1: done")
    assert capsys.readouterr().err == "1 of 1: done\n"
