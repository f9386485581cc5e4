"""The snippets of the pages are run, one behind the other."""

import re
from pathlib import Path

import pytest

PAGES = Path(__file__).parents[2] / "docs" / "plugs"
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.mark.filterwarnings("ignore:.*HalfCheetah-v4 is out of date")
@pytest.mark.parametrize("name", ["README", "gymnasium", "torchrl", "pettingzoo"])
def test_snippets_run(name, capsys):
    known = {}
    for block in PYTHON.findall((PAGES / f"{name}.md").read_text(encoding="utf-8")):
        exec(block, known)
    assert ("credit/return_r2" in capsys.readouterr().out) == (name != "README")
    assert known["credit"].store.dropped <= 4  # where a snippet begins anew
    known["credit"].close()
