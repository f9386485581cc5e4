"""Reads phi: from the text of a program to the graph of its factors. The text is data; it is never executed.

graph = read(source, observation_size=17, action_size=6)
evaluate(graph, {"observation": observation, "action": action})["factors"]
"""

import ast
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor

from lare_rl.phi.arrays import Array, concatenate
from lare_rl.phi.attributes import symbol_attribute
from lare_rl.phi.builder import Builder, building, current_builder
from lare_rl.phi.graph import Graph
from lare_rl.phi.interpreter import Interpreter
from lare_rl.phi.limits import (
    MAX_FACTORS,
    MAX_MESSAGE_LENGTH,
    MAX_MESSAGES,
    MAX_SOURCE_LENGTH,
    MAX_SYNTAX_DEPTH,
    PARSER_STACK_BYTES,
    RefusedError,
)
from lare_rl.phi.runtime import BUILTINS, Meter
from lare_rl.phi.values import (
    PYTHON_ERRORS,
    BreakSignal,
    ContinueSignal,
    Function,
    ProgramError,
    ReturnSignal,
    Scope,
    Symbol,
    describe,
)
from lare_rl.util.sanitize import first_invisible

__all__ = ["FUNCTION_NAME", "apply_program", "located_refusal", "parse", "read"]

_PARSING = threading.Lock()
"""`threading.stack_size` is for the whole process. Before Python 3.11.8 and 3.12.2, parsers in two threads may also miscount
their recursion depth (python/cpython#106905)."""


def parse(source: str) -> ast.Module:
    """Parse a source. Raises `RefusedError` if it is too long, nested too deeply, has invisible characters, or is not Python."""
    if len(source) > MAX_SOURCE_LENGTH:
        raise RefusedError("E-SIZE", f"{len(source)} characters: at most {MAX_SOURCE_LENGTH} are accepted")
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


FUNCTION_NAME = "evaluation_func"
"""The name of the function that a program must define."""


def read(source: str, observation_size: int, action_size: int, max_factors: int = MAX_FACTORS) -> Graph:
    """Read the graph of phi: `observation` (observation_size,), `action` (action_size,) -> `factors` (factors,).

    The program sees arrays (batch, observation_size) and (batch, action_size), and returns a list of arrays (batch, 1).

    Raises:
        RefusedError: the text is no such function. Each line of the message has a rule, a line of the source, what is wrong,
            and often what to write instead: the first says what stopped the reader, others name what is not available.
    """
    builder, tree = Builder(), None
    interpreter = Interpreter(builder)
    try:
        with building(builder), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = parse(source)
            interpreter.run(tree.body, interpreter.module)
            return _build_graph(interpreter, observation_size, action_size, max_factors)
    except Exception as error:  # no text may stop the process that reads it
        first = located_refusal(error, interpreter)
    further = [] if tree is None else _unavailable_names(tree, interpreter.module)
    raise RefusedError(first.code, "\n".join(dict.fromkeys([str(first), *further])), first.line)


def apply_program(source: str, observation: Array, action: Array) -> Array:
    """Carry out a program that could be read in the graph that is being built.

    Args:
        observation, action: (rows, size), with the batch axis 0: several rows for each row of the graph.

    Returns:
        The factors (rows, n_factors), with the batch axis 0.
    """
    interpreter = Interpreter(current_builder())
    observation.read_only = action.read_only = True  # as in `read`
    interpreter.run(parse(source).body, interpreter.module)
    factors = interpreter.call(interpreter.module[FUNCTION_NAME], [observation, action], {})
    return concatenate(factors, 1)


def located_refusal(error: Exception, interpreter: Interpreter) -> RefusedError:
    """Return what stopped a program as a refusal. Its message begins with the rule and the line."""
    line = interpreter.line
    match error:
        case RefusedError():
            code, message, line = error.code, str(error), error.line or line
        case _ if isinstance(error, PYTHON_ERRORS):
            code, message = "E-RUN", _error_text(error)
        case ReturnSignal() | BreakSignal() | ContinueSignal():
            code, message = "E-SYNTAX", "return outside a function, or break or continue outside a loop"
        case RecursionError() | MemoryError():
            code, message = "E-COST", "the code is nested too deeply"
        case _:
            code, message = "E-BUG", f"an error of LaRe, please report it: {_error_text(error)}"
    refusal = RefusedError(code, " ".join(message[:MAX_MESSAGE_LENGTH].split()), line)
    return RefusedError(code, refusal.located(line), line)


def _error_text(error: Exception) -> str:
    if isinstance(error, NameError):
        return f"{error} is not defined, or not available"
    return str(error) if isinstance(error, ProgramError) else f"{type(error).__name__}: {error}"


def _unavailable_names(tree: ast.Module, module: Scope) -> list[str]:
    """Return messages about the names in a program that its modules do not have: np.load, np.linalg.svdd."""
    messages = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Attribute):
            continue
        names, root = [], node
        while isinstance(root, ast.Attribute):
            names.append(root.attr)
            root = root.value
        owner = module.get(root.id) if isinstance(root, ast.Name) else None
        if isinstance(owner, Symbol) and owner.name in BUILTINS:
            continue  # the name of a function of Python may be that of a variable here
        try:
            for name in reversed(names):
                owner = symbol_attribute(owner.name, name) if isinstance(owner, Symbol) else None
        except RefusedError as refusal:
            messages.append(refusal.located(node.lineno))
            if len(messages) == MAX_MESSAGES:
                break
    return messages


def _build_graph(interpreter: Interpreter, observation_size: int, action_size: int, max_factors: int) -> Graph:
    """Call the function of a program twice: its factors must not depend on earlier calls."""
    builder, function = interpreter.builder, interpreter.module.get(FUNCTION_NAME)
    if not isinstance(function, Function):
        raise RefusedError("E-FORM", f"there is no function {FUNCTION_NAME}(observation, action)")
    sizes = {"observation": observation_size, "action": action_size}
    inputs = {name: builder.input(name, (size,)) for name, size in sizes.items()}
    outputs = []
    for _ in range(2):
        arrays = [Array(builder.reshape(inputs[name], (1, size)), 0) for name, size in sizes.items()]
        for array in arrays:
            array.read_only = True
        outputs.append(_check_factors(interpreter.call(function, arrays, {}), max_factors))
        interpreter.meter = Meter()
        builder.work.clear()
    if outputs[0] != outputs[1]:
        text = "a second call gives other factors: keep nothing in module variables, defaults or closures"
        raise RefusedError("E-STATE", text)
    return builder.finish({"factors": builder.concat(outputs[0])})


def _check_factors(factors: object, max_factors: int) -> list[int]:
    """Return the nodes of the factors that a function has returned."""
    builder = current_builder()
    if not isinstance(factors, (list, tuple)):
        raise RefusedError("E-FORM", f"{FUNCTION_NAME} must return a list of arrays, not {_describe_shape(factors)}")
    if not 1 <= len(factors) <= max_factors:
        most = "exactly one reward array" if max_factors == 1 else f"1 to {max_factors} factors"
        raise RefusedError("E-FORM", f"{FUNCTION_NAME} must return {most}, not {len(factors)}")
    for number, factor in enumerate(factors, start=1):
        if not isinstance(factor, Array) or factor.batch_axis != 0 or factor.row_shape != (1, 1):
            text = f"factor {number} must be an array of the shape (batch, 1), not {_describe_shape(factor)}"
            if isinstance(factor, Array) and factor.row_shape == (1,):
                text += ": write observation[:, 8:9] instead of observation[:, 8], or keepdims=True in a sum"
            raise RefusedError("E-FORM", text)
    return [builder.reshape(builder.cast(factor.node, "float"), (1,)) for factor in factors]


def _describe_shape(value: object) -> str:
    return f"of the shape {value.shape}" if isinstance(value, Array) else describe(value)
