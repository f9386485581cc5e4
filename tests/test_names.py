"""Identifiers are nouns and verbs of the field. Words that say nothing about a value are banned."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
BANNED = set(
    """one found place places part parts given known shown said told there own left held kept whole taken made paid judged drawn
    every each some others theirs ours mine owe owed untold unseen led_to rivals usual in_force set_in_vain improve_one descends
    begin_again annotate joined asked""".split()
)
GENITIVE = re.compile(r"^_?of_\w+$")
EXCEPTIONS: dict[str, int] = {"src/lare_rl/phi/numpy_functions/tables.py": 3}
"""How many banned identifiers a file may have. These numbers may only fall."""


def identifiers(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name) | ast.arg(arg=name) | ast.Attribute(attr=name):
                yield name
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.MatchAs(name=str(name)):
                yield name
            case ast.ExceptHandler(name=str(name)) | ast.keyword(arg=str(name)):
                yield name
            case ast.alias(name=module, asname=name):
                yield name or module.rpartition(".")[2]


WRITTEN_BY_MODELS = ROOT / "benchmarks" / "real" / "phi"
"""Texts of a language model, which are data."""


@cache
def is_banned(name: str) -> bool:
    return name in BANNED or GENITIVE.match(name) is not None


def test_no_identifier_is_banned():
    counts = {}
    for folder in ("src", "tests", "benchmarks", "examples", "docs"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            if path.is_relative_to(WRITTEN_BY_MODELS):
                continue
            text = path.read_text(encoding="utf-8")
            banned = list(filter(is_banned, identifiers(ast.parse(text))))
            if re.search(r"from hypothesis import .*\bgiven\b", text):
                banned = [name for name in banned if name != "given"]  # a decorator of the field
            if banned:
                counts[str(path.relative_to(ROOT))] = banned
    more = {path: sorted(set(names)) for path, names in counts.items() if len(names) > EXCEPTIONS.get(path, 0)}
    fewer = {path: n for path, n in EXCEPTIONS.items() if len(counts.get(path, ())) < n}
    assert more == {}
    assert fewer == {}, "lower the numbers in EXCEPTIONS"
