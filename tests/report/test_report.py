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
from lare_rl.report.live_page import PAGE, LivePage

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two small runs of a toy."""
    directory = tmp_path_factory.mktemp("runs")
    td3 = {"hidden": (8,), "batch_size": 8, "warmup": 36}
    tiny = {"steps": 240, "rollout_steps": 12, "evaluate_every": 60, "evaluation_episodes": 2, "td3": td3}
    return [
        lare_rl.train(toy_spec(), lare_rl.Settings(method=method, **tiny), out=directory / method, listeners=[])
        for method in ("bayes", "episodic")
    ]


def test_sections_of_report(runs, tmp_path):
    page = lare_rl.write_report(runs, tmp_path / "report.html").read_text()
    diagnoses = re.findall(r'<p class="verdict"><strong>(.*?)\.</strong> (.*?)</p>', page)
    assert [name for name, _ in diagnoses] == ["bayes", "episodic"]
    # The first run is compared with the second one, which was trained on the return of the episode alone.
    assert ["return of the episode alone" in text for _, text in diagnoses] == [True, False]
    sections = (
        "verdict",
        "<table>",
        "<svg",
        "bayes on Chase",
        "Credit over one episode",
        "Settings",
        "episodic on Chase",
    )
    positions = [page.index(section) for section in sections]
    assert positions == sorted(positions)
    assert "<code>" in page
    assert 'src="data:image/gif' not in page


def test_names_of_runs(runs, tmp_path):
    page = lare_rl.write_report([runs[0], runs[0].directory, runs[1]], tmp_path / "report.html").read_text()
    assert re.findall(r'<p class="verdict"><strong>(.*?)\.</strong>', page) == ["bayes #1", "bayes #2", "episodic"]


def test_film_in_report(runs, tmp_path):
    Image.new("RGB", (8, 8)).save(runs[0].directory / "film.gif")
    assert 'src="data:image/gif;base64,' in lare_rl.write_report(runs[0], tmp_path / "report.html").read_text()
    (runs[0].directory / "film.gif").unlink()


@pytest.mark.parametrize(
    ("arguments", "words"), [(([],), "No runs"), ((["RUN"], "none/report.html"), "there is no folder")]
)
def test_report_errors(runs, tmp_path, arguments, words):
    sources, *out = arguments
    sources = [runs[0] for _ in sources]
    with pytest.raises(lare_rl.LareError, match=words):
        lare_rl.write_report(sources, *(tmp_path / path for path in out))


def episodic_chase(**settings):
    """A chase whose only reward comes at its last step."""
    return lare_rl.EpisodicReward(gymnasium.wrappers.TimeLimit(Chase(**settings), 20))


gymnasium.register("toys/EpisodicChase-v0", entry_point=episodic_chase, max_episode_steps=20)


def test_unknown_step_rewards(small, phi, tmp_path):
    """If only the last step has a reward, there is no error, no correlation, and no curve of true rewards."""
    about_true_rewards = (
        "credit error",
        "Correlation: Pearson",
        "true reward</text>",
        "correlation with the true reward",
    )

    def texts_in_report(name, **task):
        run = lare_rl.train(
            toy_spec(**task), small(method="lare-bayes", steps=240), function=phi, out=tmp_path / name, listeners=[]
        )
        page = lare_rl.write_report(run, tmp_path / f"{name}.html").read_text()
        assert "R² of returns" in page
        assert "proxy reward" in page
        return [text for text in about_true_rewards if text in page]

    assert texts_in_report("unknown", environment="toys/EpisodicChase-v0") == []
    assert texts_in_report("known") == list(about_true_rewards)


def test_live_page(small, tmp_path, monkeypatch):
    opened, pages = [], []
    monkeypatch.setattr(webbrowser, "open", opened.append)

    class Reader(LivePage):
        def on_evaluation(self, metrics):
            super().on_evaluation(metrics)
            pages.append((out / PAGE).read_text())

    out = tmp_path / "run"
    lare_rl.train(toy_spec(), small(method="dense", steps=120), out=out, listeners=[Reader(out)])
    assert opened == [(out / "watch.html").resolve().as_uri()]
    assert [re.search(r"Step (\d+) of 120", page)[1] for page in pages] == ["60", "120"]
    assert all('<meta http-equiv="refresh" content="10">' in page for page in pages)
    assert "refresh" not in (out / "watch.html").read_text()


def test_html_is_escaped():
    assert render_table(("<a>",), [("<b>",)], numbers=[0]).count("&lt;") == 2
    assert (
        render_lines(["<x>", "- <y>", "- z", "w"])
        == "<p>&lt;x&gt;</p>\n<ul><li>&lt;y&gt;</li><li>z</li></ul>\n<p>w</p>"
    )


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
@pytest.mark.parametrize(("width", "columns"), [(390, 1), (1280, 2)])
def test_page_fits_phone_and_desktop(runs, tmp_path, width, columns):
    """Nothing is wider than the screen, and curves stand side by side where there is room."""
    page = lare_rl.write_report(runs, tmp_path / "report.html")
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
