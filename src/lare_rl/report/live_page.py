"""A page that shows a run while it trains: the diagnosis and the curves, redrawn after every evaluation."""

import webbrowser
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lare_rl.errors import LareError
from lare_rl.evaluation.evaluate import measure_random_returns
from lare_rl.report.html import render_note, write_page
from lare_rl.report.overview import render_learning_curves, render_verdict, summarise_runs
from lare_rl.report.reported_run import ReportedRun
from lare_rl.runs.config_file import read_config
from lare_rl.runs.directory import LIVE_PAGE, open_without_functions
from lare_rl.training.progress import Listener, MetricLines

__all__ = ["LivePage"]

REFRESH_S = 10
"""Seconds after which a browser reloads the page."""


class LivePage(Listener):
    """A listener that writes the page. It ignores errors of writing.

    Args:
        directory: the run's directory.
        browser: whether to open the page in the browser when training begins.
    """

    def __init__(self, directory: Path, browser: bool = True):
        self._directory, self._browser, self._is_running = directory, browser, False
        self._random_returns: Float[np.ndarray, "teams episodes"] | None = None

    def on_start(self, name: str, step: int, steps: int) -> None:
        self._is_running = True
        self._write()
        if self._browser:
            webbrowser.open((self._directory / LIVE_PAGE).resolve().as_uri())

    def on_evaluation(self, metrics: MetricLines) -> None:
        if self._random_returns is None:  # not before the first step, because it may take minutes
            self._random_returns = measure_random_returns(read_config(self._directory).task)
        self._write()

    def on_stop(self) -> None:
        if self._is_running:
            self._is_running = False
            self._write()

    def _write(self) -> None:
        with suppress(LareError):
            run = open_without_functions(self._directory)
            task, settings = run.config.task, run.config.settings
            random_returns = np.zeros((len(task.roles), 0)) if self._random_returns is None else self._random_returns
            reported = ReportedRun(settings.method, run)
            title = f"{task.name}: {settings.method}"
            (summary,) = summarise_runs([reported], random_returns)
            state = f"reloaded every {REFRESH_S} seconds" if self._is_running else "not running"
            steps = f"Step {reported.last_step:,} of {settings.steps:,}"
            sections = [
                *render_verdict(reported, summary),
                *render_learning_curves(task, [reported], random_returns),
                render_note(f"{steps}; {state}. lare-rl report draws credit and factors too."),
            ]
            write_page(self._directory / LIVE_PAGE, title, "\n".join(sections), REFRESH_S if self._is_running else None)
