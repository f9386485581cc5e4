"""LaRe: train reinforcement learning on episodic rewards, through latent rewards that a language model wrote.

task = lare_rl.load_task("HalfCheetah-v4")
phi = lare_rl.design(task)
run = lare_rl.train(task, lare_rl.Settings(steps=100_000), function=phi)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lare_rl._version import __version__

if TYPE_CHECKING:
    from lare_rl.assigner.assigner import CreditAssigner as CreditAssigner
    from lare_rl.config.settings import Settings as Settings
    from lare_rl.envs.episodic import EpisodicReward as EpisodicReward
    from lare_rl.envs.load import load_task as load_task
    from lare_rl.errors import LareError as LareError
    from lare_rl.evaluation.evaluate import evaluate_run as evaluate_run
    from lare_rl.evaluation.policy import policy_of as policy_of
    from lare_rl.export.export import export as export
    from lare_rl.latent.design import design as design
    from lare_rl.latent.function import LatentFunction as LatentFunction
    from lare_rl.latent.saved import load as load_function  # noqa: F401
    from lare_rl.logs.relabel import relabel as relabel
    from lare_rl.logs.steps import logged_steps as logged_steps
    from lare_rl.report.report import write_report as write_report
    from lare_rl.runs.directory import Run as Run
    from lare_rl.runs.directory import open_run as open_run
    from lare_rl.tasks.spec import TaskSpec as TaskSpec
    from lare_rl.training.reflect import reflect as reflect
    from lare_rl.training.stored_episodes import stored_episodes as stored_episodes
    from lare_rl.training.train import resume as resume
    from lare_rl.training.train import train as train

HOMES = {
    "LareError": "lare_rl.errors",
    "evaluate_run": "lare_rl.evaluation.evaluate",
    "policy_of": "lare_rl.evaluation.policy",
    "write_report": "lare_rl.report.report",
    "export": "lare_rl.export.export",
    "design": "lare_rl.latent.design",
    "LatentFunction": "lare_rl.latent.function",
    "load_function": "lare_rl.latent.saved:load",
    "relabel": "lare_rl.logs.relabel",
    "logged_steps": "lare_rl.logs.steps",
    "CreditAssigner": "lare_rl.assigner.assigner",
    "EpisodicReward": "lare_rl.envs.episodic",
    "TaskSpec": "lare_rl.tasks.spec",
    "load_task": "lare_rl.envs.load",
    "Run": "lare_rl.runs.directory",
    "open_run": "lare_rl.runs.directory",
    "Settings": "lare_rl.config.settings",
    "reflect": "lare_rl.training.reflect",
    "resume": "lare_rl.training.train",
    "stored_episodes": "lare_rl.training.stored_episodes",
    "train": "lare_rl.training.train",
}
"""The module of each public name. A name is imported on its first use, so that `lare-rl --help`, and the process that
verifies generated code, need not wait for JAX."""

__all__ = ["__version__", *HOMES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module 'lare_rl' has no attribute {name!r}")
    module, _, attribute = HOMES[name].partition(":")
    return getattr(import_module(module), attribute or name)


def __dir__() -> list[str]:
    return __all__
