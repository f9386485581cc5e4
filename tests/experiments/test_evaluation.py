import numpy as np
import pytest

from lare.errors import LareError
from lare.experiments.evaluation import check_video, evaluate_run, write_video


def test_a_gif_is_written(tmp_path):
    frames = [np.full((16, 16, 3), 20 * number, np.uint8) for number in range(5)]
    write_video(tmp_path / "film.gif", frames, 0.05)
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF8")


def test_a_video_nowhere_is_one_line(tmp_path):
    with pytest.raises(LareError, match="cannot be written"):
        write_video(tmp_path / "none" / "film.gif", [np.zeros((16, 16, 3), np.uint8)] * 2, 0.05)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("film.xyz", r"film\.xyz is no name of a video: it ends in \.gif, or in \.mp4"),
        ("none/film.gif", r"film\.gif cannot be written: there is no directory .*none$"),
    ],
)
def test_a_video_that_could_not_be_written_is_not_begun(tmp_path, name, message):
    with pytest.raises(LareError, match=message):
        check_video(tmp_path / name)


def test_no_run_and_no_episodes(tmp_path):
    with pytest.raises(LareError, match=r"is not a run: there is no config\.json in it"):
        evaluate_run(tmp_path)
    with pytest.raises(LareError, match="episodes = 0: at least one is needed"):
        evaluate_run(tmp_path, 0)
