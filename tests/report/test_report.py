"""The report: what it says on top, and how it looks in a browser."""

import re
import shutil
import subprocess

import gymnasium
import pytest
from PIL import Image

import lare_rl
from helpers.toys import Chase, toy_spec
from lare_rl.evaluation import evaluate as evaluation
from lare_rl.evaluation.evaluate import random_returns
from lare_rl.report import live_page as live
from lare_rl.report.live_page import LivePage

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two small runs of a toy."""
    place = tmp_path_factory.mktemp("runs")
    td3 = {"hidden": (8,), "batch_size": 8, "warmup": 36}
    tiny = {"steps": 240, "rollout_steps": 12, "evaluate_every": 60, "evaluation_episodes": 2, "td3": td3}
    return [
        lare_rl.train(toy_spec(), lare_rl.Settings(method=method, **tiny), out=place / method, listeners=[])
        for method in ("bayes", "episodic")
    ]


def test_a_verdict_stands_on_top(runs, tmp_path):
    page = lare_rl.write_report(runs, tmp_path / "report.html").read_text()
    verdicts = re.findall(r'<p class="verdict"><strong>(.*?)\.</strong> (.*?)</p>', page)
    assert [name for name, _ in verdicts] == ["bayes", "episodic"]
    assert "random actions get " in verdicts[0][1]
    compared = "training on the return at the end alone gives here"
    assert re.search(f"(more than|less than|about as much as) {compared}", verdicts[0][1])
    assert compared not in verdicts[1][1]
    assert page.index("verdict") < page.index("<table>") < page.index("<svg")
    assert "<code>" in page


def at_the_end(**settings):
    """A chase that pays nothing before its last step."""
    return lare_rl.EpisodicReward(gymnasium.wrappers.TimeLimit(Chase(**settings), 20))


gymnasium.register("toys/ChaseAtTheEnd-v0", entry_point=at_the_end, max_episode_steps=20)


def test_nothing_is_shown_that_is_not_known(small, phi, tmp_path):
    """True rewards of steps are unknown if only the last one is paid: no error, no correlation, no curve of them."""
    of_true = ("credit error", "Correlation: Pearson", "true reward</text>", "correlation with the true reward")
    task = toy_spec(environment="toys/ChaseAtTheEnd-v0")
    run = lare_rl.train(task, small(method="lare-bayes", steps=240), function=phi, out=tmp_path / "run", listeners=[])
    page = lare_rl.write_report(run, tmp_path / "report.html").read_text()
    assert "R² of returns" in page
    assert "proxy reward" in page
    assert [words for words in of_true if words in page] == []
    known = lare_rl.train(
        toy_spec(), small(method="lare-bayes", steps=240), function=phi, out=tmp_path / "known", listeners=[]
    )
    page = lare_rl.write_report(known, tmp_path / "known.html").read_text()
    assert [words for words in of_true if words not in page] == []


def test_random_play_is_bounded(monkeypatch):
    assert len(random_returns(toy_spec())) == evaluation.RANDOM_EPISODES
    monkeypatch.setattr(evaluation, "PATIENCE", -1.0)
    assert len(random_returns(toy_spec())) == 0
    assert len(random_returns(toy_spec(environment="no-such-environment"))) == 0


def test_a_film_that_is_there_is_in_the_page(runs, tmp_path):
    Image.new("RGB", (8, 8)).save(runs[0].directory / "film.gif")
    assert 'src="data:image/gif;base64,' in lare_rl.write_report(runs[0], tmp_path / "report.html").read_text()
    (runs[0].directory / "film.gif").unlink()


def test_a_page_shows_a_run_while_it_trains(small, tmp_path, monkeypatch):
    opened, pages = [], []
    monkeypatch.setattr(live.webbrowser, "open", opened.append)

    class Reader(LivePage):
        def evaluated(self, metrics):
            super().evaluated(metrics)
            pages.append((self.directory / live.PAGE).read_text())

    out = tmp_path / "run"
    lare_rl.train(toy_spec(), small(method="dense", steps=120), out=out, listeners=[Reader(out)])
    assert opened == [(out / "watch.html").resolve().as_uri()]
    assert [re.search(r"Step (\d+) of 120; reloaded every 10 seconds", page)[1] for page in pages] == ["60", "120"]
    assert all('<meta http-equiv="refresh" content="10">' in page for page in pages)
    assert "refresh" not in (out / "watch.html").read_text()


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
@pytest.mark.parametrize(("width", "columns"), [(390, 1), (1280, 2)])
def test_the_page_fits_a_phone_and_a_desktop(runs, tmp_path, width, columns):
    """No part is wider than the screen, and curves stand side by side where there is room."""
    page = lare_rl.write_report(runs, tmp_path / "report.html")
    probe = (
        "<script>document.title = JSON.stringify([document.documentElement.scrollWidth, "
        "getComputedStyle(document.querySelector('.figures')).gridTemplateColumns.split(' ').length])</script>"
    )
    framed = tmp_path / "framed.html"  # Chromium makes no window as narrow as a phone
    (tmp_path / "probed.html").write_text(page.read_text().replace("</body>", f"{probe}</body>"))
    framed.write_text(
        f'<iframe src="probed.html" width="{width}" height="800" style="border: 0"></iframe>'
        "<script>onload = () => document.body.append(frames[0].document.title)</script>"
    )
    command = [
        CHROMIUM,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--allow-file-access-from-files",
        f"--user-data-dir={tmp_path / 'profile'}",
    ]
    done = subprocess.run(
        [*command, "--virtual-time-budget=5000", "--dump-dom", framed.as_uri()],
        capture_output=True,
        text=True,
        check=True,
    )
    found = re.search(r"\[(\d+),(\d+)\]", done.stdout)
    assert found, done.stdout + done.stderr
    assert (int(found[1]) <= width, int(found[2])) == (True, columns)
