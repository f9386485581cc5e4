"""The page of credited rollouts: which ones it shows, and how it writes numbers and texts."""

import numpy as np
import pytest

from lare_rl.turns.credit import TurnCredit
from lare_rl.turns.features import tabulate
from lare_rl.turns.page import choose_rollouts, write_turn_report
from lare_rl.turns.rollouts import read_rollouts
from lare_rl.turns.words import count_decimals


def random_rollouts(n_successes=5, scale=1.0, n_turns=4):
    """Return ten groups of ten rollouts, in which an event is more frequent before a success."""
    random = np.random.default_rng(0)
    return [
        {
            "turns": [{"event": int(random.random() < (0.8 if k < n_successes else 0.3))} for _ in range(n_turns)],
            "outcome": scale * (k < n_successes),
            "group": group,
        }
        for group in range(10)
        for k in range(10)
    ]


def write(directory, rollouts, **options):
    checked = read_rollouts(rollouts)
    credit = TurnCredit(**options).assign(tabulate(checked))
    html = write_turn_report(directory / "page.html", rollouts, checked, credit).read_text()
    return html, credit, [checked[k].outcome for k in choose_rollouts(checked, credit)]


@pytest.mark.parametrize(
    ("n_successes", "outcomes"),
    [(n, [1, 0, 1, 0, 1, 0]) for n in (1, 5, 9)] + [(10, [1] * 6)],
)
def test_successes_and_failures_alternate(n_successes, outcomes):
    checked = read_rollouts(random_rollouts(n_successes))
    credit = TurnCredit().assign(tabulate(checked))
    assert [checked[k].outcome for k in choose_rollouts(checked, credit)] == outcomes


def test_page_escapes_and_cuts_texts(tmp_path):
    rollouts = [{"turns": [{"<script>": k % 2}], "outcome": k % 2, "group": "<i>" + "x" * 100} for k in range(20)]
    html, _, outcomes = write(tmp_path, rollouts)
    assert "<script>" not in html
    assert "<i>" not in html
    assert "x" * 87 + "...:" in html
    assert outcomes == [1, 0, 1, 0, 1, 0]


def test_numbers_have_the_unit_of_outcomes(tmp_path):
    assert [count_decimals(std) for std in (0.5, 1.0, 5e-5, 500.0, 1e6, 0.0)] == [3, 2, 7, 0, 0, 3]
    html, credit, _ = write(tmp_path, random_rollouts(scale=1e-4))
    (effect,) = credit.effects
    assert f"{effect.first:+.7f} ± {effect.first_std:.7f}" in html
    assert f"{effect.first:+.7f} ± {effect.first_std:.7f}" in credit.words[1]


def test_logistic_effects_are_log_odds(tmp_path):
    for logistic in (False, True):
        html, credit, _ = write(tmp_path, random_rollouts(), logistic=logistic)
        assert ("log odds" in html) == ("changes the log odds" in credit.words[1]) == logistic
