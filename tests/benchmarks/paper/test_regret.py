import numpy as np
import pytest

from paper import regret
from paper.exhibits import budgets


@pytest.mark.long
def test_the_page(monkeypatch):
    monkeypatch.setattr(regret, "REDUNDANT", (1, 6))
    page = regret.make_page(budgets()["smoke"], "lare-rl reproduce theory")
    rows = [line.split("|") for line in page.text.splitlines() if line.startswith(("| 1 (latent)", "| 6 "))]
    assert [row[2].strip() for row in rows] == ["6", "36"]
    assert [row[7].strip() for row in rows] == ["3 of 3", "3 of 3"]
    means = [float(row[3].split("±")[0]) for row in rows]
    assert np.isclose(means[1] / means[0], float(rows[1][4]), atol=0.02)
    assert page.pictures["theory-regret.svg"].startswith("<svg")
