"""What the user is told when something that they gave cannot be used."""

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError


class LareError(Exception):
    """A mistake that its reader can mend.

    The message is one line: what was wrong, where, and what would be right. The command line prints it without a
    traceback and exits with status 2.
    """


class Checked(BaseModel):
    """Values that came from outside. Frozen; what does not fit is a `LareError` of one line."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    def __init__(self, /, **values: Any):
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise LareError(first_problem(error)) from error


def first_problem(error: ValidationError) -> str:
    """The first thing that pydantic found wrong, in one line, and how many more there are."""
    problems = error.errors()
    first = problems[0]
    where, what = ".".join(str(part) for part in first["loc"]), first["msg"].removeprefix("Value error, ")
    if first["type"] == "missing":
        said = f"the key {where!r} is missing"
    elif first["type"] == "extra_forbidden":
        said = f"there is no key {where!r}"
    elif where:
        said = f"{where} = {first['input']!r}: {what.lower()}"
    else:
        said = what
    return said + (f" (and {len(problems) - 1} more)" if len(problems) > 1 else "")
