import os
import re
import shutil
import subprocess
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import lare_rl
from helpers.markup import check_markup
from helpers.toy_envs import Chase, toy_spec
from helpers.untrained_runs import write_run
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.envs.load import load_task
from lare_rl.evaluation.video import encode_film
from lare_rl.report.messages import MESSAGES
from lare_rl.report.overview import render_learning_curves, summarise_runs
from lare_rl.report.report import _load_film, default_path
from lare_rl.report.reported_run import ReportedRun
from lare_rl.report.run_summary import summarise_run
from lare_rl.runs.directory import open_without_functions

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)


def episodic_chase(**settings):
    """A chase whose only reward comes at its last step."""
    return lare_rl.EpisodicReward(gymnasium.wrappers.TimeLimit(Chase(**settings), 20))


gymnasium.register("toys/EpisodicChase-v0", entry_point=episodic_chase, max_episode_steps=20)


@pytest.fixture(scope="module")
def runs(small, phi, tmp_path_factory):
    """Two small runs of a toy, one with rewards at each step, and one with a reward at the last step. They compile as those of exports."""
    directory, settings = tmp_path_factory.mktemp("runs"), small(method="lare-bayes", capacity=240)
    return [
        lare_rl.train(toy_spec(environment=name), settings, function=phi, out=directory / name[5:-3], listeners=[])
        for name in ("toys/Chase-v0", "toys/EpisodicChase-v0")
    ]


def page_of(sources, tmp_path, **options):
    page = lare_rl.write_report(sources, tmp_path / "report.html", **options).read_text()
    check_markup(page[page.index("<body>") : page.index("</html>")])
    return page


@pytest.fixture(scope="module")
def pages(runs, tmp_path_factory):
    """The page of each run."""
    return [page_of(run, tmp_path_factory.mktemp("page")) for run in runs]


def columns(page):
    """The cells of each column of each table, without the header."""
    for table in re.findall(r"<table>(.*?)</table>", page, re.DOTALL):
        rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in table.split("</tr>")[1:]]
        yield from zip(*filter(None, rows), strict=True)


def n_lines(chart, style):
    return len(re.findall(rf'<polyline class="{style}"', chart))


def test_sections_of_report(runs, pages):
    page = pages[0]
    classes = [f'class="{name}' for name in ("headline", "tiles", "chart", "strip")]
    positions = [page.index(section) for section in (*classes, "The latent function", "config.json")]
    assert positions == sorted(positions)
    assert page.count("<dt>") == 4  # the numbers of the header
    assert 'src="data:image/webp' not in page
    assert all(any(cell not in ("", "-") for cell in column) for column in columns(page))
    assert "<script" not in page
    assert len(page) < 600_000
    first_chart = page[page.index('class="chart') :].partition("</svg>")[0]
    assert n_lines(first_chart, "c0 thin") == len(runs[0].seeds)
    assert n_lines(first_chart, "c0") == n_lines(first_chart, "grey dashed") == 1
    assert "<title>step" in first_chart


@pytest.mark.parametrize("method", ["bayes", pytest.param("dense", marks=pytest.mark.long)])
def test_method_without_phi(method, small, tmp_path):
    run = lare_rl.train(toy_spec(), small(method=method, capacity=240), out=tmp_path / "run", listeners=[])
    page = page_of(run, tmp_path)
    assert "The latent function" not in page


def test_film(runs, tmp_path):
    """It is in the page if it is newer than the checkpoint, and small."""
    film, size = runs[0].directory / "film.webp", 10_000
    film.write_bytes(encode_film([np.zeros((300, 300, 3), np.uint8)] * 2, 0.1, size))
    assert page_of(runs[0], tmp_path).count('src="data:image/webp;base64,') == 1
    assert "data:image/webp" not in page_of(runs[0], tmp_path, film=False)
    assert _load_film(runs[0], size) == film.read_bytes()
    assert _load_film(runs[0], film.stat().st_size - 1) is None
    os.utime(film, (0, 0))
    assert _load_film(runs[0], size) is None
    film.unlink()


def test_report_of_several_runs(make_run, tmp_path):
    """The best ones have colours, and only settings that differ are listed."""
    runs = [
        make_run(f"run{i}", [10.0 * i, 10.0 * i + 1], method=method)
        for i, method in enumerate(["dense", "rd", "ircr", "rrd", "bayes", "episodic"])
    ]
    page = page_of(runs, tmp_path)
    chart = page[page.index('class="chart') :].partition("</svg>")[0]
    assert [n_lines(chart, style) for style in ("c0", "c1", "c2", "c3", "grey faint")] == [1, 1, 1, 1, 2]
    settings = page[page.index("differ between") :].partition("</table>")[0]
    assert "method" in settings
    assert "evaluation_episodes" not in settings
    assert page.count("<summary>All settings") == 1


def test_names_of_runs(make_run, tmp_path):
    """A report of several runs does not replace that of the first one."""
    first, second = make_run("a", [1.0]), make_run("<b>", [2.0], method="rd")
    page = page_of([second, first.directory, first], tmp_path)
    assert re.findall(r"<summary>(.*?): ", page) == ["rd", "dense (a) #2", "dense (a) #3"]
    page = page_of([first, make_run("<b>c", [2.0])], tmp_path)
    assert "<b>" not in page
    assert "&lt;b&gt;c" in page
    assert default_path([tmp_path]) == tmp_path / "report.html"
    assert default_path([tmp_path, tmp_path / "b"]) == Path("report.html")
    for sources, out, words in (
        ([], "report.html", "No runs"),
        (7, "report.html", "lare_rl.open_run"),
        ([first], "no/report.html", "no directory"),
    ):
        with pytest.raises(lare_rl.LareError, match=words):
            lare_rl.write_report(sources, tmp_path / out)


def test_summary_of_runs(make_run):
    """A run is compared with the best that was trained on the return of the episode alone, which is not compared with itself."""
    first, second, third = (
        ReportedRun(f"{method} {value}", make_run(f"{method} {value}", [value, value + 1], method=method))
        for method, value in [("rd", 9.0), ("episodic", 1.0), ("episodic", 3.0)]
    )
    for runs, reference in (
        ([first, second], (1.5, 2, None, 0.5)),
        ([first, second, third], (3.5, 2, third.name, 0.5)),
    ):
        summaries = summarise_runs(runs, np.zeros((1, 0)))
        assert [summary.episodic for summary in summaries] == [reference] + [None] * (len(runs) - 1)
    assert first.training_seconds() is None
    for line in first.metrics:
        line["time/steps_per_second"] = line["step"] / 10
    assert first.training_seconds() == pytest.approx(50 / 5 + 50 / 10)


def test_error_of_the_mean_gain(make_run):
    """It is an error over the seeds whose gain is known."""

    def gain_and_error(*errors):
        reported = ReportedRun("a", make_run(f"{errors}", [1.0] * len(errors), method="bayes"))
        for line, error in zip(reported.metrics, 2 * errors, strict=True):
            line |= {} if error is None else {"credit/gain": 0.3, "credit/gain_error": error}
        score_use = summarise_run(reported, np.zeros(0), None).score_use
        return score_use.gain, score_use.gain_error

    assert gain_and_error(0.2) == gain_and_error(0.2, None, None, None) == pytest.approx((0.3, 0.2))
    assert gain_and_error(0.3, 0.4) == pytest.approx((0.3, 0.25))


def test_each_team_is_compared_with_its_own_random_returns(tmp_path):
    task = load_task("CompetitivePP-6")
    settings = resolve(Settings(method="dense"), task)
    names = ("return", "return_std")
    metrics = [
        {"step": 1, "seed": 0, **{f"evaluation/{name}_{team}": 1.0 for name in names for team in ("predator", "prey")}}
    ]
    write_run(tmp_path / "run", task, settings, metrics)
    reported = ReportedRun("a", open_without_functions(tmp_path / "run"))
    charts = [
        "".join(render_learning_curves(task, [reported], np.array(returns))).split('class="chart')[1:]
        for returns in ([[0.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [-9.0, -9.0]])
    ]
    assert [first == second for first, second in zip(*charts, strict=True)] == [True, False]
    assert all('class="band c0"' in chart for chart in charts[0])  # as the legend says


def test_damaged_checkpoint_costs_only_what_it_shows(runs, make_run, tmp_path):
    damaged = tmp_path / "damaged"
    shutil.copytree(runs[0].directory, damaged)
    (damaged / "checkpoint" / "state.npz").write_bytes(b"PK")
    page = page_of(damaged, tmp_path, film=False)
    assert "no credit and factors to show" in page
    assert 'class="chart' in page


def test_run_without_evaluation(make_run, tmp_path):
    """Its report has what there is: the settings."""
    empty = make_run("b", [1.0], steps=())
    page = page_of(empty, tmp_path)
    assert page.count(MESSAGES["no_evaluation"]) == 1
    assert "config.json" in page
    assert 'class="chart' not in page
    page = page_of([empty, make_run("a", [1.0], method="rd")], tmp_path)
    assert page.count(MESSAGES["no_evaluation"]) == 1
    assert 'class="chart' in page


def test_unknown_step_rewards(pages):
    """If only the last step has a reward, there is no error, no correlation, and no picture of true rewards."""
    for text in ("|proxy - true reward|", "Correlation of", ">true reward</li>", "correlation with the true reward"):
        assert [text in page for page in pages] == [True, False]
    for text in ("R² of returns", ">proxy reward</li>"):
        assert all(text in page for page in pages)
    assert "credit can be trusted" in pages[1] or "Trust the credit in part" in pages[1]
    assert "The score was taken as" not in pages[1]  # of equal lengths


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
@pytest.mark.long
@pytest.mark.parametrize(("width", "columns"), [(390, 1), (1280, 2)])
def test_page_fits_phone_and_desktop(pages, tmp_path, width, columns):
    """Nothing is wider than the screen, no text is smaller than 11 pixels, and curves stand side by side where there is room."""
    probe = (
        "<script>document.querySelectorAll('details').forEach(fold => fold.open = true);"
        "const sizes = [...document.body.querySelectorAll('*')].map(node => parseFloat(getComputedStyle(node).fontSize));"
        "document.title = JSON.stringify([document.documentElement.scrollWidth, Math.floor(Math.min(...sizes)), "
        "getComputedStyle(document.querySelector('.figures')).gridTemplateColumns.split(' ').length])</script>"
    )
    (tmp_path / "probe.html").write_text(pages[0].replace("</body>", f"{probe}</body>"))
    frame = tmp_path / "frame.html"  # Chromium makes no window as narrow as a phone
    frame.write_text(
        f'<iframe src="probe.html" width="{width}" height="800" style="border: 0"></iframe>'
        "<script>onload = () => document.body.append(frames[0].document.title)</script>"
    )
    flags = "--headless --no-sandbox --disable-gpu --allow-file-access-from-files --virtual-time-budget=5000 --dump-dom"
    command = [CHROMIUM, *flags.split(), f"--user-data-dir={tmp_path / 'profile'}", frame.as_uri()]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    match = re.search(r"\[(\d+),(\d+),(\d+)\]", result.stdout)
    assert match, result.stdout + result.stderr
    assert int(match[1]) <= width
    assert int(match[2]) >= 11
    assert int(match[3]) == columns
