"""The tables of task keys and of settings."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from types import SimpleNamespace

from pydantic.fields import FieldInfo

from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.config.settings import Settings
from lare_rl.credit.decoder_settings import MULTI_AGENT_CREDIT, CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.errors import CheckedModel
from lare_rl.tasks.spec import TaskSpec
from reference_tables.cells import NONE, code, codes, default, docstring_text, kind, parameters, table

__all__ = ["settings_page", "tasks_page"]

TASK_GROUPS = {
    "The environment": "name environment evaluation_environment observation_size action_size max_episode_steps arguments agents processes "
    "timeout",
    "Texts for the language model": "description observation action",
    "What an episode is paid for": "score payments paid_for group",
    "What phi and the decoder read": "scored_observation credit_scope",
    "Teams and measures": "teams team measures",
}

RUN_GROUPS = {
    "The run": "method algorithm steps seeds seed scored_observation draw candidates",
    "Collection and evaluation": "environments rollout_steps capacity overlap_collection scale_rewards evaluate_every "
    "evaluation_episodes",
    "Fits of the decoder": "fit_every fit_updates first_fit",
}

ALGORITHM_GROUPS = {"TD3, DDPG and SAC": "td3 ddpg sac", "PPO and IPPO": "ppo ippo", "QMIX and VDN": "qmix vdn"}


FORMS = (
    ("TOML", "`evaluate_every = 1000`", "`td3 = { warmup = 1000 }`", "`credit = { batch_steps = 512 }`"),
    ("command line", "`--evaluate-every 1000`", "`--td3.warmup 1000`", "`--credit.batch-steps 512`"),
    ("Python: `Settings(...)`", "`evaluate_every=1000`", '`td3={"warmup": 1000}`', '`credit={"batch_steps": 512}`'),
)
"""How settings are given."""


def tasks_page() -> str:
    """Return the page about the keys of a task file."""
    check_complete(TASK_GROUPS.values(), TaskSpec.model_fields)
    lines = [
        "# Keys of a task file",
        "A task file is TOML ([tutorial](../tutorials/your-own-environment.md)). In Python, the keys are the fields of "
        '`lare_rl.TaskSpec`. `like = "NAME"` takes the keys that a file leaves out from a built-in task or another file.',
    ]
    for title, names in TASK_GROUPS.items():
        rows = []
        for name in names.split():
            field = TaskSpec.model_fields[name]
            rows.append((code(name), value_and_default(field), docstring_text(field.description)))
        lines += [f"## {title}", parameters(rows)]
    return "\n\n".join(lines)


def value_and_default(field: FieldInfo) -> str:
    """Return the kind of a key's values, and the default."""
    if field.is_required():
        return f"{kind(field)}, required"
    value = default(field.get_default(call_default_factory=True))
    return kind(field) if value == NONE else f"{kind(field)}; default {value}"


def settings_page() -> str:
    """Return the page about the settings of a run, of the algorithms and of the decoder."""
    check_complete(RUN_GROUPS.values(), set(Settings.model_fields) - {*ALGORITHMS, "credit"})
    check_complete(ALGORITHM_GROUPS.values(), ALGORITHMS)
    lines = [
        "# Settings",
        table(("where", "a run's setting", "an algorithm's", "the decoder's"), FORMS),
        "Defaults are in parentheses. Without one, the task and the algorithm decide. `config.json` has the values that a run used.",
    ]
    for title, names in RUN_GROUPS.items():
        fields = {name: Settings.model_fields[name] for name in names.split()}
        rows = (
            (code(name), default(field.default).removeprefix(NONE), docstring_text(field.description))
            for name, field in fields.items()
        )
        lines += [f"## {title}", parameters(rows)]
    for title, names in ALGORITHM_GROUPS.items():
        lines += [f"## {title}", algorithm_settings(names.split())]
    lines += ["## The decoder (`credit`)", decoder_settings()]
    return "\n\n".join(lines)


def algorithm_settings(names: list[str]) -> str:
    """Return the settings of several algorithms."""
    settings = {code(name): ALGORITHMS[name].settings for name in names}
    fields = {field: info for values in settings.values() for field, info in type(values).model_fields.items()}
    rows = ((code(name), defaults(name, settings), docstring_text(field.description)) for name, field in fields.items())
    return parameters(rows)


def defaults(setting: str, variants: Mapping[str, CheckedModel]) -> str:
    """Return the default of a setting. If variants differ, or lack it, their names are before their defaults."""
    names = defaultdict(list)
    for name, values in variants.items():
        if hasattr(values, setting):
            names[default(getattr(values, setting))].append(name)
    first, *rest = (f"{', '.join(group)}: {cell}" for cell, group in names.items())
    complete = all(hasattr(values, setting) for values in variants.values())
    return "; ".join([next(iter(names)) if complete else first, *rest])


def decoder_settings() -> str:
    """Return the settings of the decoder."""
    changes = ALGORITHMS["qmix"].run_defaults(SimpleNamespace(is_jax=True, max_steps=1), None)["credit"]
    variants = {"one agent": CreditSettings(), "many agents": MULTI_AGENT_CREDIT}
    rows = []
    for name, field in CreditSettings.model_fields.items():
        note = defaults(name, variants) + (f"; `qmix`, `vdn`: {default(changes[name])}" if name in changes else "")
        rows.append((code(name), note, f"{docstring_text(field.description)} For {readers(name)}."))
    return parameters(rows)


def readers(name: str) -> str:
    """Return the methods that read a setting of the decoder, in the shortest way."""
    all_fits = [method for method in METHODS.values() if method.fit is not None]
    groups = {
        "all": all_fits,
        "gradient descent": [method for method in all_fits if method.uses_gradient],
        "closed forms": [method for method in all_fits if not method.uses_gradient],
    }
    reading = {method.name for method in all_fits if name in method.settings}
    texts = [codes(sorted(reading))]
    for group, methods in groups.items():
        missing = {method.name for method in methods} - reading
        if reading <= {method.name for method in methods}:
            texts.append(f"{group}, but not {codes(sorted(missing))}" if missing else group)
    return min(texts, key=len)


def check_complete(groups: Iterable[str], names: Iterable[str]) -> None:
    """Raise `ValueError` unless the groups have each name once."""
    grouped = sorted(" ".join(groups).split())
    if grouped != sorted(names):
        raise ValueError(f"the groups have {grouped}, and the code has {sorted(names)}")
