import numpy as np
import pytest

from helpers.toy_envs import toy_spec
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.credit.methods import METHODS
from lare_rl.report.messages import MESSAGES
from lare_rl.report.score_use import summarise_score_use
from lare_rl.util.findings import render

METRICS = {"average": np.nan, "log_odds": np.nan, "gain": 0.5, "gain_error": 0.05}


def describe(method="bayes", metrics=METRICS, task=None, equal_lengths=False, **credit):
    task = toy_spec().model_copy(update=task or {})
    settings = resolve(Settings(method=method, credit=credit), task)
    use = summarise_score_use(METHODS[method], settings, task, metrics, equal_lengths=equal_lengths)
    finding = None if use is None else use.finding()
    return use, "" if finding is None else render(finding, MESSAGES)


@pytest.mark.parametrize(
    ("method", "metrics", "task", "credit", "words"),
    [
        ("bayes", {}, {}, {}, ["sum over the steps", "in part", "50% ± 5%", "their mean"]),
        ("bayes", {"gain": 0.05}, {}, {}, ["It is not clear", "5% ± 5%", "their mean"]),
        ("bayes", {"gain": 0.35, "gain_error": 0.2}, {}, {}, ["It is not clear", "35% ± 20%"]),
        ("bayes", {"gain": 0.95}, {}, {}, ["can be trusted", "95%"]),
        ("rd", {"average": 1.0}, {}, {}, ["average"]),
        ("rudder", {}, {"score": "average"}, {}, ["sum over the steps"]),  # it does not read the score
        ("bayes", {}, {"payments": 5}, {"exact": "spread"}, ["every 5 steps", "mean payment", "spread"]),
        ("bayes", {}, {"group": "map"}, {}, ["intercept for each group", "mean of their group"]),
        ("bayes", {"log_odds": 1.0, "gain": 0.2}, {}, {"score": "binary"}, ["log odds", "chance"]),
        ("bayes-history", {}, {}, {}, ["extremes"]),
        ("bayes-progress", {}, {}, {}, ["expected value", "last step"]),
    ],
)
def test_score_use(method, metrics, task, credit, words):
    _, sentence = describe(method, METRICS | metrics, task, **credit)
    assert all(word in sentence for word in words), sentence


def test_sum_and_average_of_equal_lengths_are_not_told_apart():
    assert describe(equal_lengths=True)[1].startswith("Trust the credit in part")
    assert describe(equal_lengths=True, task={"group": "map"})[1].startswith("The score was taken as")
    assert describe("bayes-history", equal_lengths=True)[1].startswith("The score was taken as")


def test_nothing_is_said_without_predictions():
    assert describe(metrics=METRICS | {"gain": np.nan, "gain_error": np.nan})[1] == ""
    assert describe("ircr")[0] is None
