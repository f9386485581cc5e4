"""A page that shows a run while it trains: the verdict and the curves, redrawn after every evaluation."""

import webbrowser
from contextlib import suppress
from html import escape
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.evaluation.evaluate import random_returns
from lare_rl.report.html import note, write_page
from lare_rl.report.report import learning, verdicts
from lare_rl.runs.directory import read_measured
from lare_rl.training.progress import Metrics

PAGE = "watch.html"
"""The file in the run's directory."""

REFRESH = 10
"""Seconds after which a browser reloads the page."""


class LivePage:
    """Writes the page, and opens it in the browser when training begins if `browser`. Errors of writing are ignored."""

    def __init__(self, directory: Path, browser: bool = True):
        self.directory, self.browser, self.running, self.random = directory, browser, False, None

    def started(self, name: str, step: int, steps: int) -> None:
        self.running = True
        self.draw()
        if self.browser:
            webbrowser.open((self.directory / PAGE).resolve().as_uri())

    def stepped(self, step: int) -> None: ...
    def said(self, message: str) -> None: ...

    def evaluated(self, metrics: Metrics) -> None:
        self.draw()

    def stopped(self) -> None:
        if self.running:
            self.running = False
            self.draw()

    def draw(self) -> None:
        """Write the page for the current state of the run."""
        with suppress(LareError):
            run = read_measured(self.directory)
            task, method = run.config.task, run.config.settings.method
            if self.random is None:
                self.random = random_returns(task)
            title = f"{task.name}: {method}"
            parts = [f"<h1>{escape(title)}</h1>"]
            if metrics := run.metrics():
                parts += [*verdicts({method: run}, self.random), *learning(task.name, {method: run}, self.random)]
                done = metrics[-1]["step"]
            else:
                done = 0
            state = f"reloaded every {REFRESH} seconds" if self.running else "not running"
            parts.append(
                note(
                    f"Step {done:,} of {run.config.settings.steps:,}; {state}. lare-rl report draws credit and factors too."
                )
            )
            write_page(self.directory / PAGE, title, "\n".join(parts), REFRESH if self.running else None)
