"""Checked models describe themselves."""

import inspect

import pytest

import lare_rl


@pytest.mark.parametrize("model", [lare_rl.TaskSpec, lare_rl.Settings])
def test_help_describes_every_field(model):
    attributes = (inspect.getdoc(model) or "").partition("Attributes:")[2]
    names = {line.partition(":")[0].strip() for line in attributes.splitlines() if line[4:5] != " "}
    algorithms = {
        name for name, field in model.model_fields.items() if isinstance(field.default, lare_rl.errors.CheckedModel)
    }
    assert names - {""} == set(model.model_fields) - algorithms
