import io
import json
import threading

from rich.console import Console
from rich.progress import Progress

from helpers.toy_envs import toy_spec
from lare_rl.cli.sweep_progress import update_bars
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.sweep.jobs import Job


def make_job(directory, step):
    """A run of 100 steps that has reached a step."""
    directory.mkdir(parents=True)
    if step:
        (directory / "config.json").write_text("{}")
        (directory / "metrics.jsonl").write_text(json.dumps({"step": step, "seed": 0}) + "\n")
    settings = Settings(method="dense", steps=100, evaluate_every=50)
    return Job(directory, toy_spec(), settings, resolve(settings, toy_spec()))


def test_update_bars(tmp_path):
    jobs = [make_job(tmp_path / "Chase" / name, step) for name, step in (("a", 0), ("b", 50), ("c", 50))]

    class TwoUpdates(threading.Event):
        n_waits = 0

        def wait(self, timeout=None):
            self.n_waits += 1
            (jobs[2].directory / "metrics.jsonl").write_text('{"step": 100, "seed": 0}\n')
            return self.is_set()

        def is_set(self):
            return self.n_waits == 2

    bars = Progress(console=Console(file=io.StringIO()))
    update_bars(jobs, bars, TwoUpdates())
    assert [(bar.description, bar.completed, bar.total, bar.visible) for bar in bars.tasks] == [
        ("all runs", 150, 300, True),
        ("Chase/b", 50, 100, True),
        ("Chase/c", 100, 100, False),
    ]
