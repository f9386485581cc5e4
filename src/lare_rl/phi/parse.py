"""The syntax tree of a program, for texts of any kind: limits are checked before Python's parser sees the text.

The parser recurses in C. It stops at limits of its own, but needs up to 8 MB of stack until then and would crash in a thread that
has less. So it runs in a thread with a stack of 32 MB.
"""

import ast
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor

from lare_rl.phi.limits import MAX_SOURCE_LENGTH, MAX_SYNTAX_DEPTH, PARSER_STACK_BYTES, RefusedError
from lare_rl.util.sanitize import first_invisible

_PARSING = threading.Lock()
"""`threading.stack_size` is for the whole process. Before Python 3.11.8 and 3.12.2, parsers in two threads may also miscount their
recursion depth (python/cpython#106905)."""


def parse(source: str) -> ast.Module:
    """Parse a source.

    Raises:
        RefusedError: it is too long, nested too deeply, has invisible characters, or is not Python.
    """
    if len(source) > MAX_SOURCE_LENGTH:
        raise RefusedError(
            "E-SIZE", f"the program has {len(source)} characters: at most {MAX_SOURCE_LENGTH} are accepted"
        )
    hidden = first_invisible(source)
    if hidden is not None:
        line = source.count("\n", 0, hidden) + 1
        raise RefusedError("E-SYNTAX", f"{source[hidden]!a} is a character that no reader sees: remove it", line)
    try:
        tree = _parse_in_thread(source)
    except SyntaxError as error:
        raise RefusedError("E-SYNTAX", error.msg, error.lineno) from None
    except (ValueError, MemoryError, RecursionError) as error:
        raise RefusedError("E-SYNTAX", f"this is not Python: {error or type(error).__name__}") from None
    level, depth = [tree], 0
    while level:
        depth += 1
        level = [child for node in level for child in ast.iter_child_nodes(node)]
    if depth > MAX_SYNTAX_DEPTH:
        raise RefusedError("E-SIZE", f"the code is nested {depth} levels deep: at most {MAX_SYNTAX_DEPTH} are accepted")
    return tree


def _parse_in_thread(source: str) -> ast.Module:
    with _PARSING, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about escapes in texts
        before = threading.stack_size(PARSER_STACK_BYTES)
        try:
            with ThreadPoolExecutor(1) as pool:
                return pool.submit(ast.parse, source).result()
        finally:
            threading.stack_size(before)
