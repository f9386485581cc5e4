"""What the user is told when something that they gave cannot be used."""


from pydantic import ValidationError


class LareError(Exception):
    """A mistake that its reader can mend.

    The message is one line: what was wrong, where, and what would be right. The command line prints it without a
    traceback and exits with status 2.
    """


def first_problem(error: ValidationError) -> str:
    """The first thing that pydantic found wrong, in one line, and how many more there are."""
    problems = error.errors()
    first = problems[0]
    where = ".".join(str(part) for part in first["loc"]) or "the whole"
    if first["type"] == "missing":
        what = f"the key {where!r} is missing"
    elif first["type"] == "extra_forbidden":
        what = f"there is no key {where!r}"
    else:
        what = f"{where} = {first['input']!r}: {first['msg'].lower()}"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return what + more
