from pathlib import Path

import pytest

from lare_rl.compare.results import LearningCurves, read_run_results
from lare_rl.compare.scores import group_results
from lare_rl.errors import LareError
from lare_rl.runs.metric_names import RETURN


def curves(label, *steps_of_seeds):
    """Return the curves of a method in a table, with the value 1 at some steps of each seed."""
    values = {seed: dict.fromkeys(steps, 1.0) for seed, steps in enumerate(steps_of_seeds)}
    return LearningCurves(label=label, source=Path("own.csv"), task="Chase", draw=0, curves=values)


def test_steps_without_overlap_are_listed_by_method():
    with pytest.raises(LareError) as error:
        group_results([curves("A", (1000, 1500), (1500, 2000)), curves("B", (3000, 4000), (3000, 4000))])
    first, second = str(error.value).split(";")
    for text, words in ((first, ["A", "1,000 to 2,000"]), (second, ["B", "3,000 to 4,000"])):
        assert all(word in text for word in ["Chase", "own.csv", *words]), text


def test_same_draw_twice(make_run):
    runs = [make_run(name, [1.0], method="lare-rrdu", draw=2) for name in "ab"]
    with pytest.raises(LareError, match=r"seed 0 .*draw 2"):
        group_results(read_run_results({"A": runs}, RETURN))
