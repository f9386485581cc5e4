"""Settings and specs, which are checked, also describe themselves."""

import inspect

import pytest

import lare_rl


@pytest.mark.parametrize("kind", [lare_rl.TaskSpec, lare_rl.Settings])
def test_help_describes_every_field(kind):
    told = (inspect.getdoc(kind) or "").partition("Attributes:")[2]
    named = {line.partition(":")[0].strip() for line in told.splitlines() if line[4:5] != " "}
    silent = {name for name, field in kind.model_fields.items() if isinstance(field.default, lare_rl.errors.Checked)}
    assert named - {""} == set(kind.model_fields) - silent


def test_help_says_what_a_field_is():
    assert "    score: Whether the return of an episode is a sum over its steps," in (
        inspect.getdoc(lare_rl.TaskSpec) or ""
    )
