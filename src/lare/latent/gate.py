"""The static gate: what a program may consist of, read off its syntax tree. Nothing is executed.

A closed language: a node, name, attribute, keyword or string that `language` does not list is refused. This is what makes
errors precise and most attacks unspeakable; it is not the boundary. The boundary is the `jail` in which the gate itself,
and everything after it, runs.
"""

import ast
import re
from collections.abc import Iterator

from lare.latent.expressions import Problem
from lare.latent.grammar import Gate, recursion
from lare.latent.syntax import definitions

LONGEST = 20_000
"""Bytes of a program."""

DEEPEST_BRACKETS = 40
DEEPEST = 100
"""Of the syntax tree."""

CHAIN = re.compile(r"(?:[-+~]\s*){12}|(?:\bnot\s+){12}|(?:\blambda\s*:\s*){12}")
"""Operators that nest without brackets, and would go deep into the parser's own stack."""

HIDDEN = re.compile(
    r"[\x00-\x08\x0b\x0e-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb]"
)
"""What steers a terminal, or the direction of writing: who reads a function must see what there is."""

UNREAD = re.compile(r'"""[^\\]*?"""|#[^\n]*', re.DOTALL)
"""Comments and docstrings, where rulers and smileys are welcome. Who hides code from this meets the parser's own limits."""


def inspect(source: str) -> list[Problem]:
    """Everything that is wrong with a program, in the order of its lines; nothing, where it may go on to be run."""
    too_much = list(guard(source))
    if too_much:
        return too_much
    try:
        tree = ast.parse(source)
    except SyntaxError as error:
        return [Problem("E-SYNTAX", error.lineno or 1, error.msg)]
    except (ValueError, MemoryError, RecursionError) as error:
        return [Problem("E-SYNTAX", 1, f"this cannot be parsed: {str(error) or type(error).__name__}")]
    if depth(tree) > DEEPEST:
        return [Problem("E-SIZE", 1, f"the expressions are nested more than {DEEPEST} deep")]
    gate = Gate(definitions(tree))
    gate.visit(tree)
    return sorted({*gate.problems, *recursion(tree, gate.functions)}, key=lambda problem: (problem.line, problem))


def guard(source: str) -> Iterator[Problem]:
    """What must be known before the parser sees a text."""
    size = len(source.encode(errors="replace"))
    if any("\ud800" <= letter <= "\udfff" for letter in source):
        yield Problem("E-SYNTAX", 1, "there are characters that are no text (surrogates)")
        return
    hidden = HIDDEN.search(source)
    if hidden:
        line = source.count("\n", 0, hidden.start()) + 1
        yield Problem("E-SYNTAX", line, f"there is {hidden[0]!a}, a character that nobody sees: only text, please")
        return
    if size > LONGEST:
        yield Problem("E-SIZE", 1, f"the program has {size} bytes; at most {LONGEST} are accepted")
        return
    code = UNREAD.sub(lambda found: "\n" * found[0].count("\n"), source)
    nested = 0
    for number, line in enumerate(code.split("\n"), start=1):
        for character in line:
            nested = max(0, nested + (character in "([{") - (character in ")]}"))
            if nested > DEEPEST_BRACKETS:
                yield Problem("E-SIZE", number, f"brackets are nested more than {DEEPEST_BRACKETS} deep")
                return
    chain = CHAIN.search(code)
    if chain:
        yield Problem("E-SIZE", code.count("\n", 0, chain.start()) + 1, "a chain of operators is too long")


def depth(tree: ast.AST) -> int:
    """Levels of a syntax tree."""
    level, found = [tree], 0
    while level:
        found += 1
        level = [child for node in level for child in ast.iter_child_nodes(node)]
    return found
