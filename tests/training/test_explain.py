"""The sentences that a user without dense rewards reads."""

import jax
import numpy as np
import pytest

import lare_rl
from helpers.tiers import long
from helpers.toys import Ear, toy_spec
from lare_rl.credit.explanation import Explanation
from lare_rl.credit.explanation_text import entry_names, words
from lare_rl.credit.returns import FormFound
from lare_rl.envs.load import read_task
from lare_rl.latent.function import verified
from lare_rl.training.explain import explanation_of


def found(**changes):
    values = {
        "episodes": 40,
        "of_steps": False,
        "varied": np.array([True, True]),
        "by_factors": 0.9,
        "by_all": 0.97,
        "of_entries": np.zeros(2),
        "slope": np.array([1.0, 2.0]),
        "uncertainty": np.diag([0.01, 0.01]),
        "linear": np.array([0.81, 1.0]),
        "share": np.array([0.25, 0.65]),
        "paired": np.zeros(2),
        "left": np.array([0.1, -0.8]),
    }
    return Explanation(**(values | changes))


SHARES = (
    "For each factor: its share of the variation (0%: it does not matter, or its mean hardly differed between episodes; below "
    "0%: it offsets others), and by how much a step's reward rises with one standard deviation of it:"
)
SET_IT = (
    'If you know which of them it is, set it: `score = "sum"` or `score = "average"` in the task file, `--credit.score`, or '
    "`CreditSettings(score=...)`."
)
FACTORS, ENTRIES = ["speed", "cost"], ["entry 0", "entry 1 (the foot)"]


@pytest.mark.parametrize(
    ("given", "form", "factors", "entries", "said"),
    [
        (
            found(),
            None,
            FACTORS,
            ENTRIES,
            [
                "The factors explain 90% of the variation of the returns of 40 episodes, raw entries another 7%.",
                SHARES,
                "- cost: 65%, +2 ± 0.1",
                "- speed: 25%, +1 ± 0.1",
                "Returns are higher than the factors predict when entry 1 (the foot) is small (correlation -0.80): "
                "a factor may be missing, or the task's `judges` may be wrong.",
            ],
        ),
        (
            found(by_factors=0.05, by_all=0.05, left=np.zeros(2)),
            FormFound(average=True, decided=True),
            FACTORS,
            ENTRIES,
            [
                "The score is treated as an average over the steps of an episode: so far, this predicts returns better than a sum. "
                f"This may change. {SET_IT}",
                "The factors explain 5% of the variation of the returns of 40 episodes.",
                "Warning: phi explains next to nothing of the score. Its factors are not what the score is made of, or the "
                "episodes are too few or too much alike to show it.",
            ],
        ),
        (
            found(by_factors=0.99, by_all=0.99, share=np.array([0.99, -0.001])),
            FormFound(average=False, decided=True),
            FACTORS,
            [],
            [
                "The score is treated as a sum over the steps of an episode: so far, this predicts returns better than an average. "
                f"This may change. {SET_IT}",
                "The factors explain 99% of the variation of the returns of 40 episodes.",
                SHARES,
                "- speed: 99%, +1 ± 0.1",
                "- cost: 0%, +2 ± 0.1",
            ],
        ),
        (
            found(by_factors=0.05, by_all=0.05, left=np.zeros(2)),
            FormFound(average=False, decided=False),
            [],
            [],
            [
                "The score is treated as a sum over the steps of an episode: so far, an average predicts returns about as well. "
                f"This may change. {SET_IT}",
                "Raw entries explain 5% of the variation of the returns of 40 episodes.",
            ],
        ),
        (
            found(by_factors=0.99, by_all=0.99, linear=np.array([0.79, 0.1]), share=np.array([0.95, 0.04])),
            None,
            FACTORS,
            [],
            [
                "The factors explain 99% of the variation of the returns of 40 episodes.",
                SHARES,
                "- speed: 95%, +1 ± 0.1 (its effect is curved)",
                "- cost: 4%, +2 ± 0.1",
            ],
        ),
        (
            found(by_all=0.9, paired=np.array([0.13, 0.3]), linear=np.zeros(2)),
            None,
            FACTORS,
            [],
            [
                "The factors explain 90% of the variation of the returns of 40 episodes.",
                SHARES,
                "- cost: 65%, +2 ± 0.1 (its effect is curved)",
                "- speed: 25%, +1 ± 0.1 (its effect depends on another factor)",
            ],
        ),
        (
            found(by_factors=0.99, by_all=0.99, varied=np.array([True, False]), share=np.array([0.99, 0.0])),
            None,
            ["speed (before)", "speed (after)"],
            [],
            [
                "The factors explain 99% of the variation of the returns of 40 episodes.",
                SHARES,
                "- speed: 99%, +1 ± 0.1 (before: +1 ± 0.1; after: its mean is the same in all episodes, so returns do not tell "
                "what it pays)",
            ],
        ),
        (
            found(by_factors=0.99, by_all=0.99, uncertainty=np.array([[0.01, -0.0098], [-0.0098, 0.01]])),
            None,
            ["speed (before)", "speed (after)"],
            [],
            [
                "The factors explain 99% of the variation of the returns of 40 episodes.",
                SHARES,
                "- speed: 90%, +3 ± 0.02 (before: +1 ± 0.1; after: +2 ± 0.1)",
                "In brackets are the parts of the states before and after the step. If their ± are as large as the numbers, the "
                "fit cannot tell the two apart, and only their sum counts. If they are much larger than their sum, the change of "
                "the factor in a step is paid.",
            ],
        ),
        (
            found(by_factors=0.99, by_all=0.99, slope=np.array([-20.5, 20.1])),
            None,
            ["ready (before)", "ready (after)"],
            [],
            [
                "The factors explain 99% of the variation of the returns of 40 episodes.",
                SHARES,
                "- ready: 90%, its change in a step is paid (before: -20.5 ± 0.1; after: +20.1 ± 0.1)",
                "In brackets are the parts of the states before and after the step. If their ± are as large as the numbers, the "
                "fit cannot tell the two apart, and only their sum counts. If they are much larger than their sum, the change of "
                "the factor in a step is paid.",
            ],
        ),
        (
            found(of_steps=True),
            None,
            [],
            [],
            ["Raw entries explain 97% of the variation of the mean reward of a step in 40 episodes."],
        ),
        (found(), None, [], [], ["Raw entries explain 97% of the variation of the returns of 40 episodes."]),
        (
            found(of_entries=np.array([0.2, 0.77])),
            None,
            [],
            ENTRIES,
            [
                "Raw entries explain 97% of the variation of the returns of 40 episodes. The largest shares: entry 1 (the foot) "
                "77%, entry 0 20%."
            ],
        ),
        (
            found(by_factors=0.8, left=np.zeros(2), of_entries=np.array([0.02, 0.4])),
            None,
            FACTORS,
            ENTRIES,
            [
                "The factors explain 80% of the variation of the returns of 40 episodes, raw entries another 17%.",
                SHARES,
                "- cost: 65%, +2 ± 0.1",
                "- speed: 25%, +1 ± 0.1",
                "In a fit on factors and raw entries, these entries have the largest shares: entry 1 (the foot) 40%. phi may lack "
                "a factor that is computed from them.",
            ],
        ),
        (found(episodes=19), None, FACTORS, ENTRIES, []),
        (
            found(by_all=np.nan),
            None,
            FACTORS,
            ENTRIES,
            [
                "There is nothing to explain: in all episodes the return is the same, or, if the score is a sum, the mean reward "
                "of a step."
            ],
        ),
    ],
)
def test_sentences(given, form, factors, entries, said):
    assert words(given, form, factors, entries) == said


def test_entries_have_the_names_that_the_tasks_text_gives_them():
    task = read_task("HalfCheetah-v4")
    names = entry_names(task.observation, task.action, 23, task.action_size, both=False)
    assert names[7] == "entry 7 of the observation (angle of the front foot (rad))"
    assert names[17].startswith("entry 0 of the action")
    assert len(names) == 23
    assert entry_names("", "", 3, 1, both=False) == [
        "entry 0 of the observation",
        "entry 1 of the observation",
        "entry 0 of the action",
    ]
    assert entry_names("0: price", "", 3, 1, both=True) == [
        "entry 0 of the observation before the step (price)",
        "entry 0 of the observation after the step (price)",
        "entry 0 of the action",
    ]


@pytest.mark.parametrize("method", ["lare-bayes", long("lare-rd"), long("rrdu")])
def test_a_run_is_explained(method, small, tmp_path):
    source = "def evaluation_func(o, a):\n    return [o[:, 0:1] * a[:, 0:1], o[:, 1:2]]\n"
    function = verified(source, toy_spec()) if method != "rrdu" else None
    settings = small(method=method, algorithm="td3", seeds=1, steps=600)
    ear = Ear()
    run = lare_rl.train(toy_spec(), settings, function=function, out=tmp_path / "run", listeners=[ear])
    lines = explanation_of(run)
    assert any("of the variation of the returns of" in line for line in lines)
    assert ear.heard[-len(lines) :] == lines
    assert (f"not the decoder of {method}" in lines[0]) == (method != "lare-bayes")
    assert ("The factors explain" in " ".join(lines)) == (method != "rrdu")
    assert "What the returns say" in lare_rl.write_report([run.directory]).read_text()


@pytest.mark.long
def test_many_agents_are_explained_by_factors_alone(small_many, tmp_path):
    source = "def evaluation_func(o, a):\n    return [o[:, 0:1] * a[:, 0:1], o[:, 1:2]]\n"
    task = read_task("CN-6")
    run = lare_rl.train(
        task,
        small_many(method="lare-rd", seeds=1, steps=800, capacity=2000),
        function=verified(source, task),
        out=tmp_path / "run",
        listeners=[],
    )
    lines = explanation_of(run)
    assert lines
    assert "raw entries" not in " ".join(lines)
    assert jax.config.jax_enable_x64 is False
