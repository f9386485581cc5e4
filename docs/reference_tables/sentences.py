"""The pages about metrics, findings and environment variables."""

import re
from collections.abc import Mapping

from lare_rl.logs.relabel import MESSAGES as LOGS
from lare_rl.report.messages import MESSAGES as REPORT
from lare_rl.runs.metric_names import METRIC_GROUPS
from lare_rl.turns.words import MESSAGES as TURNS
from lare_rl.util.variables import VARIABLE_GROUPS
from reference_tables.cells import code, parameters
from reference_tables.conditions import CONDITIONS

__all__ = ["findings_page", "metrics_page", "variables_page"]

CATALOGUES = {"`Relabelled.findings`": LOGS, "`CreditedTurns.findings`": TURNS}
"""The catalogues whose codes Python returns."""

COUNTS = ("count", "needed")
"""Placeholders of numbers, beside those that begin with `n_`."""

PLACEHOLDER = re.compile(r"(?P<before>.?)\{(?P<name>\w+)(?P<format>:(?:\{\w+\}|[^}])*)?\}(?=(?P<after>.?))")


def metrics_page() -> str:
    """Return the page about the metrics."""
    lines = [
        "# Metrics",
        "`metrics.jsonl` has one line for each seed and evaluation. Values that are not known yet are missing or null. Keys are "
        "stable. With several teams, a key belongs to the first team, and `KEY_TEAM` to each. A task's `measures` are "
        "`evaluation/NAME`. `CreditAssigner.metrics()` returns those about credit.",
        "All evaluations of a seed play the same initial states, which no training episode has. Off-policy algorithms and continuous "
        "PPO are evaluated without noise; discrete PPO and IPPO sample their actions, as in training.",
    ]
    for title, metrics in METRIC_GROUPS.items():
        lines += [f"## {title}", parameters((code(name), "", text) for name, text in metrics.items())]
    lines += [
        "## Which credit metric to trust",
        "`credit/return_r2` is out of sample, but tests sums over episodes: neither single steps nor the division among agents. It is "
        "near 1 whatever the features are if returns depend on the length of episodes. `credit/correlation` and `credit/error` are "
        "the only use of true rewards. They are in sample, on steps of the method's own policy.",
    ]
    return "\n\n".join(lines)


def findings_page() -> str:
    """Return the page about the sentences of reports and of commands."""
    lines = [
        "# Findings",
        "The conditions of a report's sentences, and the codes of findings in Python. N is a number, a word in italics a name, "
        "… further words.",
        "## The diagnosis of a run",
        "`lare-rl report` begins with at most one sentence of each group. *Final return*: the mean over seeds at the last "
        "evaluation; its standard error is that over seeds or over episodes, whichever is larger. *Usual change*: the median "
        "difference between successive evaluations in the last half of the run.",
    ]
    for title, conditions in CONDITIONS.items():
        lines += [f"### {title}", parameters((f"“{diagnosis(name)}”", "", text) for name, text in conditions.items())]
    for title, catalogue in CATALOGUES.items():
        rows = ((code(name), "", sentence(text, catalogue)) for name, text in catalogue.items())
        lines += [f"## {title}", parameters(rows)]
    return "\n\n".join(lines)


def diagnosis(name: str) -> str:
    """Return the headline of a finding or, if it has none, the first words of its sentence."""
    text = sentence(REPORT.get(f"headline_{name}", REPORT[name]), REPORT)
    start = " ".join(re.findall(r"(?:`[^`]*`|\S)+", re.sub(r"(?<=\. ).*", "…", text))[:8])
    return start if start == text or start.endswith("…") else f"{start} …"


def sentence(template: str, catalogue: Mapping[str, str]) -> str:
    """Return a template for a reader: its placeholders as N, …, a name in italics or, in commands, in capital letters."""
    if (match := re.fullmatch(r"\{(\w+)\}(\.?)", template)) and match[1] in catalogue:
        return sentence(catalogue[match[1]], catalogue) + match[2]
    texts = re.split(r"(`[^`]*`)", template)
    return " ".join(
        "".join(command(text) if text.startswith("`") else prose(text, catalogue) for text in texts).split()
    )


def command(text: str) -> str:
    capitals = PLACEHOLDER.sub(lambda match: match["before"] + match["name"].upper(), text)
    return capitals.replace("DIRECTORY", "RUN")


def prose(text: str, catalogue: Mapping[str, str]) -> str:
    def replace(match: re.Match[str]) -> str:
        before, name = match["before"], match["name"]
        if match["format"] or name.startswith("n_") or name in COUNTS:
            return f"{before}N"
        if before.isalnum() or (before and before in ".)") or match["after"].isalnum():  # an optional addition
            return before
        return f"{before}…" if name in catalogue else f"{before}*{name.replace('_', ' ')}*"

    text = re.sub(r"(?<=\})\{\w+\}", "", text)  # additions to a placeholder
    return re.sub(r"…(; …)+\.?", "…", PLACEHOLDER.sub(replace, text))


def variables_page() -> str:
    """Return the page about environment variables."""
    lines = [
        "# Environment variables",
        "JAX, Weights & Biases, MLflow and Hugging Face read further variables.",
    ]
    for title, variables in VARIABLE_GROUPS.items():
        lines += [
            f"## {title}",
            parameters((code(name), "", text) for name, text in variables.items()),
        ]
    return "\n\n".join(lines)
