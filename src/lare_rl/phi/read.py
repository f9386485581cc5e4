"""Reads phi: from the text of a program to the graph of its factors. The text is data; it is never executed.

graph = read(source, observation_size=17, action_size=6)
evaluate(graph, {"observation": observation, "action": action})["factors"]
"""

import ast
import warnings

from lare_rl.phi.arrays import Array
from lare_rl.phi.attributes import module_attribute
from lare_rl.phi.graph import Builder, Graph, Refused, building, current_builder
from lare_rl.phi.interpreter import PYTHON_ERRORS, Interpreter
from lare_rl.phi.parse import parse
from lare_rl.phi.values import Break, Continue, Function, Meter, Named, Raised, Return, Scope

FUNCTION = "evaluation_func"
"""The name of the function that a program must define."""
MOST_FACTORS = 32
LONGEST_MESSAGE = 500
MOST_MESSAGES = 8


def read(source: str, observation_size: int, action_size: int, most_factors: int = MOST_FACTORS) -> Graph:
    """Read the graph of phi: `observation` (observation_size,), `action` (action_size,) -> `factors` (factors,).

    The program sees arrays (batch, observation_size) and (batch, action_size), and returns a list of arrays (batch, 1).

    Raises:
        Refused: the text is no such function. Each line of the message names a rule, a line of the source, what is wrong, and often
            what to write instead: first what stopped the reader, then further names that are not available.
    """
    builder, tree = Builder(), None
    interpreter = Interpreter(builder, has_yield="yield" in source)
    try:
        with building(builder), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = parse(source)
            interpreter.run(tree.body, interpreter.module)
            return _graph(interpreter, observation_size, action_size, most_factors)
    except Refused as refusal:
        code, message, line = refusal.code, str(refusal), refusal.line or interpreter.line
    except PYTHON_ERRORS as error:
        code, message, line = "E-RUN", _message(error), interpreter.line
    except (Return, Break, Continue):
        code, message = "E-SYNTAX", "return outside a function, or break or continue outside a loop"
        line = interpreter.line
    except (RecursionError, MemoryError):
        code, message, line = "E-COST", "the code is nested too deeply", interpreter.line
    except Exception as error:  # no text may stop the process that reads it
        code, message, line = "E-BUG", f"an error of LaRe, please report it: {_message(error)}", interpreter.line
    first = f"{code} line {line}: {' '.join(message[:LONGEST_MESSAGE].split())}"
    further = [] if tree is None else _unavailable_names(tree, interpreter.module)
    raise Refused(code, "\n".join(dict.fromkeys([first, *further])), line) from None


def _message(error: Exception) -> str:
    if isinstance(error, NameError):
        return f"{error} is not defined, or not available"
    return str(error) if isinstance(error, Raised) else f"{type(error).__name__}: {error}"


def _unavailable_names(tree: ast.Module, module: Scope) -> list[str]:
    """Messages about all names of modules that a program has, but that are not available: np.load, np.linalg.svd."""
    messages = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Attribute):
            continue
        names, root = [], node
        while isinstance(root, ast.Attribute):
            names.append(root.attr)
            root = root.value
        owner = module.get(root.id) if isinstance(root, ast.Name) else None
        try:
            for name in reversed(names):
                owner = module_attribute(owner.name, name) if isinstance(owner, Named) else None
        except Refused as refusal:
            messages.append(f"{refusal.code} line {node.lineno}: {refusal}")
            if len(messages) == MOST_MESSAGES:
                break
    return messages


def _graph(interpreter: Interpreter, observation_size: int, action_size: int, most_factors: int) -> Graph:
    """Call the function of a program twice: its factors must not depend on earlier calls."""
    builder, function = interpreter.builder, interpreter.module.get(FUNCTION)
    if not isinstance(function, Function):
        raise Refused("E-FORM", f"there is no function {FUNCTION}(observation, action)")
    sizes = {"observation": observation_size, "action": action_size}
    inputs = {name: builder.input(name, (size,)) for name, size in sizes.items()}
    outputs = []
    for _ in range(2):
        arrays = [Array(builder.reshape(inputs[name], (1, size)), 0, read_only=True) for name, size in sizes.items()]
        outputs.append(_factors(interpreter.call(function, arrays, {}), most_factors))
        interpreter.meter, builder.work = Meter(), 0
    if outputs[0] != outputs[1]:
        raise Refused(
            "E-STATE", "a second call gives other factors: keep nothing in module variables, defaults or closures"
        )
    return builder.finish({"factors": builder.concat(outputs[0])})


def _factors(factors: object, most_factors: int) -> list[int]:
    """The nodes of the factors that a function has returned."""
    builder = current_builder()
    if not isinstance(factors, (list, tuple)):
        raise Refused("E-FORM", f"{FUNCTION} must return a list of arrays, not {_shown(factors)}")
    if not 1 <= len(factors) <= most_factors:
        most = "exactly one reward array" if most_factors == 1 else f"1 to {most_factors} factors"
        raise Refused("E-FORM", f"{FUNCTION} must return {most}, not {len(factors)}")
    for number, factor in enumerate(factors, start=1):
        if not isinstance(factor, Array) or factor.batch_axis != 0 or factor.row_shape != (1, 1):
            hint = ": write x[:, None]" if isinstance(factor, Array) and factor.row_shape == (1,) else ""
            raise Refused(
                "E-FORM", f"factor {number} must be an array of the shape (batch, 1), not {_shown(factor)}{hint}"
            )
    return [builder.reshape(builder.cast(factor.node, "float"), (1,)) for factor in factors]


def _shown(value: object) -> str:
    return f"of the shape {value.shape}" if isinstance(value, Array) else f"a {type(value).__name__.lower()}"
