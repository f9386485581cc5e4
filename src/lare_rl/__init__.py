"""LaRe: a reward for every step, from one number per episode.

task = lare_rl.load_task("HalfCheetah-v4")
phi = lare_rl.design(task)
run = lare_rl.train(task, lare_rl.Settings(steps=100_000), function=phi)
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lare_rl._version import __version__

if TYPE_CHECKING:
    # The public names. Python imports a name on its first use, so that `lare-rl --help` need not wait for JAX.
    from lare_rl.assigner.assigner import CreditAssigner as CreditAssigner
    from lare_rl.config.settings import Settings as Settings
    from lare_rl.credit.decoder_settings import CreditSettings as CreditSettings
    from lare_rl.envs.episodic import EpisodicReward as EpisodicReward
    from lare_rl.envs.load import load_task as load_task
    from lare_rl.errors import LareError as LareError
    from lare_rl.evaluation.evaluate import evaluate_run as evaluate_run
    from lare_rl.evaluation.policy import load_policy as load_policy
    from lare_rl.export.export import export_run as export_run
    from lare_rl.latent.design import design as design
    from lare_rl.latent.function import LatentFunction as LatentFunction
    from lare_rl.latent.saved import load_function as load_function
    from lare_rl.logs.relabel import relabel as relabel
    from lare_rl.logs.steps import logged_steps as logged_steps
    from lare_rl.report.report import write_report as write_report
    from lare_rl.runs.directory import Run as Run
    from lare_rl.runs.directory import open_run as open_run
    from lare_rl.runs.plan import load_config as load_config
    from lare_rl.tasks.payments import PaymentRule as PaymentRule
    from lare_rl.tasks.spec import TaskSpec as TaskSpec
    from lare_rl.training.pure_credit import CreditSteps as CreditSteps
    from lare_rl.training.pure_credit import pure_credit as pure_credit
    from lare_rl.training.reflect import reflect as reflect
    from lare_rl.training.stored_episodes import stored_episodes as stored_episodes
    from lare_rl.training.train import resume as resume
    from lare_rl.training.train import train as train
    from lare_rl.turns.credit import TurnCredit as TurnCredit


def _read_public_names() -> dict[str, tuple[str, str]]:
    """Return the public names: the names that the block above imports. Only type checkers execute that block."""
    tree = ast.parse(Path(__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.asname or alias.name: (str(node.module), alias.name) for node in imports for alias in node.names}


PUBLIC_NAMES = _read_public_names()
"""The module of each public name, and its name there."""
__all__ = ["__version__", *PUBLIC_NAMES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in PUBLIC_NAMES:
        raise AttributeError(f"module 'lare_rl' has no attribute {name!r}")
    module, name_there = PUBLIC_NAMES[name]
    return getattr(import_module(module), name_there)


def __dir__() -> list[str]:
    return __all__
