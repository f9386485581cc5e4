"""The static gate: what a program may consist of, read off its syntax tree. Nothing is executed.

A closed language: a node, name, attribute, keyword or string that `language` does not list is refused. This is what makes
errors precise and most attacks unspeakable; it is not the boundary. The boundary is the `jail` in which the gate itself,
and everything after it, runs.
"""

import ast
import io
import re
import tokenize
from collections.abc import Iterator

from lare.latent.expressions import HUGE, Problem
from lare.latent.grammar import Gate, recursion
from lare.latent.simplify import simplified
from lare.latent.syntax import definitions
from lare.legible import unseen

LONGEST = 20_000
"""Bytes of a program."""

DEEPEST_BRACKETS = 40
DEEPEST = 100
"""Of the syntax tree."""

CHAIN = re.compile(r"(?:[-+~]\s*){12}|(?:\bnot\s+){12}|(?:\blambda\s*:\s*){12}")
"""Operators that nest without brackets, and would go deep into the parser's own stack."""

BREAKS = str.maketrans("\r\f", "\n\n")
"""What Python takes for the end of a line, or for a space."""

LETTERS = frozenset({tokenize.COMMENT, tokenize.STRING})
"""Parts of a program in which letters of every script are welcome. Elsewhere one looks like another: the Cyrillic a is no a."""

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
        said = HUGE if error.msg.startswith("Exceeds the limit") else error.msg
        return [Problem("E-NUMBER" if said == HUGE else "E-SYNTAX", error.lineno or 1, said)]
    except (ValueError, MemoryError, RecursionError) as error:
        return [Problem("E-SYNTAX", 1, f"this cannot be parsed: {str(error) or type(error).__name__}")]
    try:
        foreign = list(other_letters(source))
    except (tokenize.TokenError, SyntaxError):  # the parser's own eyes are others
        foreign = [Problem("E-SYNTAX", 1, "this cannot be taken apart: write it in ASCII")]
    if foreign:
        return foreign
    # What is written in other words may go deeper in those of the language.
    if depth(tree) > DEEPEST or depth(tree := simplified(tree)) > DEEPEST:
        return [Problem("E-SIZE", 1, f"the expressions are nested more than {DEEPEST} deep")]
    gate = Gate(definitions(tree))
    gate.visit(tree)
    return sorted({*gate.problems, *recursion(tree, gate.functions)}, key=lambda problem: (problem.line, problem))


def other_letters(source: str) -> Iterator[Problem]:
    """Letters that are not ASCII, outside of comments and strings. The source has been parsed."""
    if source.isascii():
        return
    for token in tokenize.generate_tokens(io.StringIO(source, newline=None).readline):
        if token.type not in LETTERS and not token.string.isascii():
            letter = next(one for one in token.string if not one.isascii())
            said = f"{letter!a} is no letter of a program: only ASCII stands outside of comments"
            yield Problem("E-SYNTAX", token.start[0], said)


def guard(source: str) -> Iterator[Problem]:
    """What must be known before the parser sees a text."""
    size = len(source.encode(errors="replace"))
    if any("\ud800" <= letter <= "\udfff" for letter in source):
        yield Problem("E-SYNTAX", 1, "there are characters that are no text (surrogates)")
        return
    if size > LONGEST:
        yield Problem("E-SIZE", 1, f"the program has {size} bytes; at most {LONGEST} are accepted")
        return
    hidden = unseen(source.translate(BREAKS))  # who reads a function must see what there is
    if hidden is not None:
        line, letter = source.count("\n", 0, hidden) + 1, source[hidden]
        yield Problem("E-SYNTAX", line, f"there is {letter!a}, a character that nobody sees: only text, please")
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
