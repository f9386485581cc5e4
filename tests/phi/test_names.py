"""Names and meanings of factors, as the source gives them."""

import pytest

from helpers.toy_envs import PHI, phi_source
from lare_rl.phi.names import factor_meanings, factor_names


@pytest.mark.parametrize(
    ("source", "count", "names"),
    [
        (PHI, 2, ["f_near", "f_effort"]),
        (phi_source("return [-action, action]"), 2, ["factor_1", "action"]),
        (phi_source("factors = [action, -action]\nreturn factors"), 2, ["action", "factor_2"]),
        (phi_source("f = [action, observation]\nreturn [x[:, :1] for x in f]"), 2, ["action", "observation"]),
        # Where the list is not written out, or not once, or not at the end, or not as long, there are no names in it.
        (phi_source("factors = [action]\nfactors = [action, -action]\nreturn factors"), 2, ["factor_1", "factor_2"]),
        (phi_source("factors = [action]\nfactors.append(action)\nreturn factors"), 2, ["factor_1", "factor_2"]),
        (phi_source("factors = [action]\nreturn [f for f in factors if True]"), 1, ["factor_1"]),
        (phi_source("if True:\n    return [action]"), 1, ["factor_1"]),
        (phi_source("return [x for x in (action, action)]"), 2, ["factor_1", "factor_2"]),
        (phi_source("return [action, action]"), 2, ["factor_1", "factor_2"]),  # names differ
        (phi_source("factors: list = [action, -action]\nreturn factors"), 2, ["action", "factor_2"]),
        (PHI, 3, ["factor_1", "factor_2", "factor_3"]),
        ("not (Python", 1, ["factor_1"]),
        # Another function's list is not this one's.
        ("def helper(a, b):\n    return [a, b]\n\n" + phi_source("return [b, action]"), 2, ["b", "action"]),
        (phi_source("return [a]") + "\n" + phi_source("return [action]"), 1, ["action"]),  # the last definition counts
    ],
)
def test_factor_names(source, count, names):
    assert factor_names(source, count) == names


@pytest.mark.parametrize(
    ("lines", "meaning"),
    [
        ("# how near", "how near"),
        ("# 1. how near", "how near"),
        ("# Factor 3: how near", "how near"),
        ("# how near it is,\n#   in metres", "how near it is, in metres"),
        ("# something else\n\n# how near", "how near"),
        ("# 3 metres", "3 metres"),
    ],
)
def test_factor_meanings_comment_above_an_assignment(lines, meaning):
    assert factor_meanings(phi_source(f"{lines}\nx = action\nreturn [x]"), ["x"]) == [meaning]


@pytest.mark.parametrize(
    ("body", "meanings"),
    [
        ("# not this one\n\nx = action\ny = action  # nor this\nx[0] = 1\n# nor that\nreturn [x, y]", ["", ""]),
        ("# first\nx = action\n# then\nx = -x\n# 3. effort\ny = action", ["then", "effort"]),
        # Only a numbered comment is for a factor that is assigned some lines below it.
        ("# 1. how near\nd = action\nx = -d\n# 2. effort\ny = action\nz = x", ["how near", "effort"]),
        ("# how near\nx: float = action\n# 2. effort\ny = action", ["how near", "effort"]),
    ],
)
def test_factor_meanings_of_two(body, meanings):
    assert factor_meanings(phi_source(body), ["x", "y"]) == meanings
