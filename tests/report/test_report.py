"""The pages, and how they look in a browser."""

import re
import shutil
import subprocess
import webbrowser

import gymnasium
import pytest
from PIL import Image

import lare_rl
from helpers.toy_envs import Chase, toy_spec
from lare_rl.report.html import render_lines, render_table
from lare_rl.report.live_page import LivePage

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)


def episodic_chase(**settings):
    """A chase whose only reward comes at its last step."""
    return lare_rl.EpisodicReward(gymnasium.wrappers.TimeLimit(Chase(**settings), 20))


gymnasium.register("toys/EpisodicChase-v0", entry_point=episodic_chase, max_episode_steps=20)


@pytest.fixture(scope="module")
def runs(small, phi, tmp_path_factory):
    """Two small runs of a toy, one with rewards at each step, and one with a reward at the last step."""
    directory, settings = tmp_path_factory.mktemp("runs"), small(method="lare-bayes", steps=240)
    return [
        lare_rl.train(toy_spec(environment=name), settings, function=phi, out=directory / name[5:-3], listeners=[])
        for name in ("toys/Chase-v0", "toys/EpisodicChase-v0")
    ]


def test_sections_of_report(runs, make_run, tmp_path):
    episodic = make_run("a", [-5.0, -6.0], method="episodic")
    page = lare_rl.write_report([runs[0], episodic], tmp_path / "report.html").read_text()
    diagnoses = re.findall(r'<p class="verdict"><strong>(.*?)\.</strong> (.*?)</p>', page)
    assert [name for name, _ in diagnoses] == ["lare-bayes", "episodic"]
    # The first run is compared with the second one, which was trained on the return of the episode alone.
    assert ["return of the episode alone" in text for _, text in diagnoses] == [True, False]
    sections = (
        "verdict",
        "<table>",
        "<svg",
        "lare-bayes on Chase",
        "Credit over one episode",
        "The factors",
        "The latent function",
        "Settings",
        "episodic on Chase",
        "no checkpoint",
    )
    positions = [page.index(section) for section in sections]
    assert positions == sorted(positions)
    assert "<code>" in page
    assert 'src="data:image/gif' not in page


def test_report_names_and_film(runs, make_run, tmp_path):
    first, second = make_run("a", [1.0]), make_run("b", [1.0], method="rd")
    Image.new("RGB", (8, 8)).save(runs[0].directory / "film.gif")
    page = lare_rl.write_report([runs[0], second, first.directory, first], tmp_path / "report.html").read_text()
    names = re.findall(r'<p class="verdict"><strong>(.*?)\.</strong>', page)
    assert names == ["lare-bayes", "rd", "dense (a) #3", "dense (a) #4"]
    assert page.count('src="data:image/gif;base64,') == 1
    (runs[0].directory / "film.gif").unlink()


def test_report_errors(make_run, tmp_path):
    run, empty = make_run("a", [1.0]), make_run("b", [1.0], steps=())
    for sources, out, words in (
        ([], "report.html", "No runs"),
        ([run], "none/report.html", "there is no folder"),
        ([empty], "report.html", "b has no evaluation yet"),
    ):
        with pytest.raises(lare_rl.LareError, match=words):
            lare_rl.write_report(sources, tmp_path / out)


def test_unknown_step_rewards(runs, tmp_path):
    """If only the last step has a reward, there is no error, no correlation, and no curve of true rewards."""
    about_true_rewards = (
        "credit error",
        "Correlation: Pearson",
        "true reward</text>",
        "correlation with the true reward",
    )

    def texts_in_report(run):
        page = lare_rl.write_report(run, tmp_path / "report.html").read_text()
        assert "R² of returns" in page
        assert "proxy reward" in page
        return [text for text in about_true_rewards if text in page]

    assert [texts_in_report(run) for run in runs] == [list(about_true_rewards), []]


def test_live_page(make_run, monkeypatch):
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    run, trained = make_run("a", [1.0], steps=()), make_run("b", [2.0])
    path, page = run.directory / "watch.html", LivePage(run.directory)
    page.on_stop()
    assert not path.exists()
    page.on_start("a", 0, 100)
    assert opened == [path.resolve().as_uri()]
    assert "Step 0 of 100" in path.read_text()
    shutil.copy(trained.directory / "metrics.jsonl", run.directory)
    page.on_evaluation([])
    for text in ('<meta http-equiv="refresh" content="10">', "Step 100 of 100", "<svg", 'class="verdict"'):
        assert text in path.read_text()
    page.on_stop()
    assert "refresh" not in path.read_text()


def test_html_is_escaped():
    assert render_table(("<a>",), [("<b>",)], numbers=[0]).count("&lt;") == 2
    assert (
        render_lines(["<x>", "- <y>", "- z", "w"])
        == "<p>&lt;x&gt;</p>\n<ul><li>&lt;y&gt;</li><li>z</li></ul>\n<p>w</p>"
    )


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
@pytest.mark.parametrize(("width", "columns"), [(390, 1), pytest.param(1280, 2, marks=pytest.mark.long)])
def test_page_fits_phone_and_desktop(runs, tmp_path, width, columns):
    """Nothing is wider than the screen, and curves stand side by side where there is room."""
    page = lare_rl.write_report(runs[0], tmp_path / "report.html")
    probe = (
        "<script>document.title = JSON.stringify([document.documentElement.scrollWidth, "
        "getComputedStyle(document.querySelector('.figures')).gridTemplateColumns.split(' ').length])</script>"
    )
    (tmp_path / "probe.html").write_text(page.read_text().replace("</body>", f"{probe}</body>"))
    frame = tmp_path / "frame.html"  # Chromium makes no window as narrow as a phone
    frame.write_text(
        f'<iframe src="probe.html" width="{width}" height="800" style="border: 0"></iframe>'
        "<script>onload = () => document.body.append(frames[0].document.title)</script>"
    )
    flags = "--headless --no-sandbox --disable-gpu --allow-file-access-from-files --virtual-time-budget=5000 --dump-dom"
    command = [CHROMIUM, *flags.split(), f"--user-data-dir={tmp_path / 'profile'}", frame.as_uri()]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    match = re.search(r"\[(\d+),(\d+)\]", result.stdout)
    assert match, result.stdout + result.stderr
    assert (int(match[1]) <= width, int(match[2])) == (True, columns)
