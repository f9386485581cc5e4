import ast
import inspect

from reference_tables.conditions import CONDITIONS

from lare_rl.report import diagnosis
from lare_rl.report.messages import MESSAGES

CODES = [code for group in CONDITIONS.values() for code in group]


def returned_codes():
    """Return the codes of the findings that rules return, by the source of the diagnosis."""
    returned = [
        node.value for node in ast.walk(ast.parse(inspect.getsource(diagnosis))) if isinstance(node, ast.Return)
    ]
    calls = [
        call
        for value in returned
        for call in ((value.body, value.orelse) if isinstance(value, ast.IfExp) else (value,))
    ]
    return {
        constant.value
        for call in calls
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "Finding"
        for constant in ast.walk(call.args[0])
        if isinstance(constant, ast.Constant)
    }


def test_every_finding_has_a_condition():
    assert set(CODES) <= set(MESSAGES)
    assert len(CODES) == len(set(CODES))
    assert returned_codes() <= set(CODES)
    computed = {"above_episodic", "below_episodic", "like_episodic", "score_use"}
    assert set(CODES) - returned_codes() == computed | {"trust_nothing", "trust_part", "trust_sums"}
