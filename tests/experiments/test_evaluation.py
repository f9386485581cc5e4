import numpy as np
import pytest

from lare.errors import LareError
from lare.experiments.evaluation import evaluate_run, write_video


def test_a_gif_is_written(tmp_path):
    frames = [np.full((16, 16, 3), 20 * number, np.uint8) for number in range(5)]
    write_video(tmp_path / "film.gif", frames, 20)
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF8")


def test_a_video_nowhere_is_one_line(tmp_path):
    with pytest.raises(LareError, match="cannot be written"):
        write_video(tmp_path / "none" / "film.gif", [np.zeros((16, 16, 3), np.uint8)] * 2, 20)


def test_no_run_and_no_episodes(tmp_path):
    with pytest.raises(LareError, match=r"is not a run: there is no config\.json in it"):
        evaluate_run(tmp_path)
    with pytest.raises(LareError, match="episodes = 0: at least one is needed"):
        evaluate_run(tmp_path, 0)
