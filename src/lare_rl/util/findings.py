"""A finding is a message code with its values. A catalogue, of which each package has one, maps codes to templates.

A template is a text of `str.format` with commands in backticks:

    MESSAGES = {"rising": "The return was still rising at step {step:,} ({return_:number}). Continue with `{command}`."}
    render(Finding("rising", {"step": 5000, "return_": 12.3, "command": "lare-rl train"}), MESSAGES)

A value may also be a finding, whose template is of the same catalogue, or None, which is rendered as an empty text. The elements
of a tuple are separated by commas.
"""

import math
import re
import string
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any, Literal, SupportsFloat

__all__ = ["Finding", "format_for_reader", "format_number", "render"]

Catalogue = Mapping[str, str]

_CODE = re.compile(r"`([^`]*)`")


@dataclass(frozen=True)
class Finding:
    """A message code with its values. Findings are hashable if their values are."""

    code: str
    """The key of its template in the catalogue."""
    values: Mapping[str, Any] = field(default_factory=dict)

    def __hash__(self) -> int:
        return hash((self.code, frozenset(self.values.items())))


def render(finding: Finding, catalogue: Catalogue, style: Literal["text", "html"] = "text") -> str:
    """Return a finding's sentence for the terminal (`text`) or a page (`html`, escaped).

    Raises `KeyError` if the catalogue lacks the code, or the finding a value of its template.
    """
    text = _Formatter(catalogue).vformat(catalogue[finding.code], (), finding.values)
    return _CODE.sub(r"<code>\1</code>", escape(text)) if style == "html" else text


def format_for_reader(value: Any, spec: str = "") -> str:
    """Format one value by a spec of `str.format`, or by one of these:

    * `number`: a whole number if it is large, otherwise three digits.
    * `count NOUN`: the number with its noun, in the singular or the plural, such as `1 episode` and `1,000 episodes`.
    * `r2`: two decimal places, three above 0.99.
    * `std`: two digits, for a standard deviation.
    * `error`: one digit, or a whole number if it is large, for a standard error.
    * `steps`: a round number with k or M, such as `250k`.
    * `seconds`: a duration, such as `20 s`, `4 min` or `2.2 h`.
    """
    match spec.split(" ", 1):
        case ["number"]:
            return f"{value:,.0f}" if math.isfinite(value) and abs(value) >= 100 else f"{value + 0.0:.3g}"  # not -0
        case ["count", noun]:
            return f"{value:,} {noun}" if value == 1 else f"{value:,} {noun}s"
        case ["r2"]:
            return f"{value:.3f}" if value > 0.99 else f"{value:.2f}"
        case ["std"]:
            return f"{value:,.0f}" if math.isfinite(value) and abs(value) >= 10 else f"{value:.2g}"
        case ["error"]:
            if value >= 9.5:  # it would be rounded to 1e+01
                return f"{value:,.0f}"
            return "less than 0.001" if value < 0.001 else f"{value:.1g}"
        case ["steps"]:
            return f"{value / 1e6:g}M" if value >= 1e6 else f"{value / 1e3:g}k" if value >= 1e3 else f"{value:g}"
        case ["seconds"]:
            if round(value) < 60:
                return f"{value:.0f} s"
            return f"{math.ceil(value / 60)} min" if value < 5400 else f"{value / 3600:.1f} h"
    return format(value, spec)


def format_number(value: SupportsFloat) -> str:
    """Write a number by the spec `number`."""
    return format_for_reader(float(value), "number")


@dataclass
class _Formatter(string.Formatter):
    """Formats values by `format_for_reader`, and findings by their templates."""

    catalogue: Catalogue

    def format_field(self, value: Any, format_spec: str) -> str:
        if value is None:
            return ""
        if isinstance(value, tuple):
            return ", ".join(self.format_field(element, format_spec) for element in value)
        return render(value, self.catalogue) if isinstance(value, Finding) else format_for_reader(value, format_spec)
