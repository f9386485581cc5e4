"""The page of credited rollouts: which ones it shows, and how it writes texts."""

from lare_rl.turns.credit import TurnCredit
from lare_rl.turns.features import tabulate
from lare_rl.turns.page import choose_rollouts, write_turn_report
from lare_rl.turns.rollouts import read_rollouts


def test_page_escapes_and_cuts_texts(tmp_path):
    rollouts = [{"turns": [{"<script>": k % 2}], "outcome": k % 2, "group": "<i>" + "x" * 100} for k in range(20)]
    checked = read_rollouts(rollouts)
    credit = TurnCredit().assign(tabulate(checked))
    html = write_turn_report(tmp_path / "page.html", rollouts, checked, credit).read_text()
    assert "<script>" not in html
    assert "<i>" not in html
    assert "x" * 87 + "...:" in html
    assert [checked[k].outcome for k in choose_rollouts(checked, credit)] == [1, 0, 1, 0, 1, 0]
