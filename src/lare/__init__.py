"""LaRe: train reinforcement learning on episodic rewards, through latent rewards that a language model wrote.

task = lare.load_task("HalfCheetah-v4")
phi = lare.design(task)
run = lare.train(task, lare.Settings(steps=100_000), function=phi)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from lare.deploy.export import export as export
    from lare.errors import LareError as LareError
    from lare.experiments.evaluation import evaluate_run as evaluate_run
    from lare.experiments.policy import policy_of as policy_of
    from lare.experiments.report import write_report as write_report
    from lare.latent.design import design as design
    from lare.latent.function import LatentFunction as LatentFunction
    from lare.latent.saved import load as load_function  # noqa: F401
    from lare.logs.relabel import relabel as relabel
    from lare.logs.steps import logged_steps as logged_steps
    from lare.plugs.assigner import CreditAssigner as CreditAssigner
    from lare.run.directory import Run as Run
    from lare.run.directory import open_run as open_run
    from lare.run.settings import Settings as Settings
    from lare.tasks.episodic import EpisodicReward as EpisodicReward
    from lare.tasks.load import load_task as load_task
    from lare.tasks.spec import TaskSpec as TaskSpec
    from lare.training.reflect import reflect as reflect
    from lare.training.stored import stored_episodes as stored_episodes
    from lare.training.train import resume as resume
    from lare.training.train import train as train

HOMES = {
    "LareError": "lare.errors",
    "evaluate_run": "lare.experiments.evaluation",
    "policy_of": "lare.experiments.policy",
    "write_report": "lare.experiments.report",
    "export": "lare.deploy.export",
    "design": "lare.latent.design",
    "LatentFunction": "lare.latent.function",
    "load_function": "lare.latent.saved:load",
    "relabel": "lare.logs.relabel",
    "logged_steps": "lare.logs.steps",
    "CreditAssigner": "lare.plugs.assigner",
    "EpisodicReward": "lare.tasks.episodic",
    "TaskSpec": "lare.tasks.spec",
    "load_task": "lare.tasks.load",
    "Run": "lare.run.directory",
    "open_run": "lare.run.directory",
    "Settings": "lare.run.settings",
    "reflect": "lare.training.reflect",
    "resume": "lare.training.train",
    "stored_episodes": "lare.training.stored",
    "train": "lare.training.train",
}
"""The module of each public name. A name is imported on its first use, so that `lare --help`, and the process that
verifies generated code, need not wait for JAX."""

__all__ = ["__version__", *HOMES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module 'lare' has no attribute {name!r}")
    module, _, attribute = HOMES[name].partition(":")
    return getattr(import_module(module), attribute or name)


def __dir__() -> list[str]:
    return __all__
