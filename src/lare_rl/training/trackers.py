"""Listeners that send metrics.jsonl to a tracking service. Each seed becomes a separate run of the service.

    lare_rl.train(task, settings, listeners=[Terminal(), WeightsAndBiases(project="cheetah")])

The service's own settings decide where it stores them, and whether it is reached at all (`WANDB_MODE=offline`,
`MLFLOW_TRACKING_URI`). A resumed run continues in new runs of the service, from the step of its checkpoint.

If a service fails, training goes on without it, after a warning: metrics.jsonl has every number.
"""

import contextlib
import inspect
import re
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from functools import partial, wraps
from typing import Any

from lare_rl.errors import LareError, missing_extra_error
from lare_rl.training.progress import Listener, MetricLines, known_numbers
from lare_rl.util.sanitize import one_line

__all__ = ["MLflow", "WeightsAndBiases"]


def _survive_failures(method: Callable[..., None]) -> Callable[..., None]:
    """Let a tracker's method do nothing once the service has failed. The first failure is a warning."""

    @wraps(method)
    def call(self: Any, *arguments: Any) -> None:
        if self.has_failed:
            return
        try:
            method(self, *arguments)
        except Exception as error:  # each service raises errors of its own, and those of the network
            self.has_failed = True
            name = type(self).__name__
            warnings.warn(
                f"{name} gets no more numbers, because it failed: {one_line(error).rstrip('.')}. metrics.jsonl has every number",
                RuntimeWarning,
                stacklevel=2,
            )

    return call


def _close_all(closers: Iterable[Callable[[], Any]]) -> None:
    """Close all runs of a service, even if it has failed, or fails for some of them."""
    for close in closers:
        with contextlib.suppress(Exception):
            close()


class WeightsAndBiases(Listener):
    """Sends every number to Weights & Biases, with the extra `lare-rl[wandb]`."""

    def __init__(self, **arguments: Any):
        """Take the arguments of `wandb.init`: project, group, config, mode, dir, ...

        Raises:
            LareError: wandb is not installed, or `wandb.init` has no such argument.
        """
        try:
            import wandb

            inspect.signature(wandb.init).bind(reinit="create_new", **arguments)
        except ImportError:
            raise missing_extra_error("Weights & Biases", "wandb") from None
        except TypeError as error:
            raise LareError(f"wandb.init cannot be called with these arguments: {error}") from None
        self.init, self.arguments, self.name, self.has_failed = wandb.init, arguments, "", False
        self.runs: dict[int, Any] = {}
        """The service's runs, by seed."""

    def on_start(self, name: str, step: int, steps: int) -> None:
        self.name, self.runs, self.has_failed = name, {}, False  # the listener may have been used before

    @_survive_failures
    def on_evaluation(self, metrics: MetricLines) -> None:
        for line in metrics:
            seed = line["seed"]
            if seed not in self.runs:
                arguments: dict[str, Any] = {"name": f"{self.name} seed {seed}", "group": self.name} | self.arguments
                self.runs[seed] = self.init(reinit="create_new", **arguments)
            self.runs[seed].log(known_numbers(line), step=line["step"])

    def on_stop(self) -> None:
        _close_all(run.finish for run in self.runs.values())


class MLflow(Listener):
    """Sends every number to MLflow, with the extra `lare-rl[mlflow]`."""

    def __init__(
        self, experiment: str = "lare", tracking_uri: str | None = None, parameters: Mapping[str, Any] | None = None
    ):
        """Begin or continue an experiment.

        Args:
            experiment: the name of the experiment.
            tracking_uri: the server or the directory; the default is MLflow's own setting.
            parameters: parameters that are saved with every run.

        Raises:
            LareError: mlflow is not installed, the tracking server or directory cannot be used, or the experiment was deleted.
        """
        try:
            from mlflow import MlflowClient
            from mlflow.entities import Metric, Param
            from mlflow.exceptions import MlflowException
        except ImportError:
            raise missing_extra_error("MLflow", "mlflow") from None
        self.metric = Metric
        self.parameters = [Param(key, str(value)) for key, value in (parameters or {}).items()]
        try:
            self.client = MlflowClient(tracking_uri)
            existing = self.client.get_experiment_by_name(experiment)
            self.experiment = existing.experiment_id if existing else self.client.create_experiment(experiment)
        except (MlflowException, OSError) as error:
            raise LareError(f"MLflow cannot be used: {error}") from error
        if existing and existing.lifecycle_stage != "active":
            raise LareError(f"the experiment {experiment!r} of MLflow was deleted: restore it, or choose another name")
        self.name, self.has_failed = "", False
        self.runs: dict[int, str] = {}
        """The ids of the service's runs, by seed."""

    def on_start(self, name: str, step: int, steps: int) -> None:
        self.name, self.runs, self.has_failed = name, {}, False  # the listener may have been used before

    @_survive_failures
    def on_evaluation(self, metrics: MetricLines) -> None:
        now_ms = int(1000 * time.time())
        for line in metrics:
            seed = line["seed"]
            if seed not in self.runs:
                run = self.client.create_run(self.experiment, run_name=f"{self.name} seed {seed}")
                self.runs[seed] = run.info.run_id
                self.client.log_batch(self.runs[seed], params=self.parameters)
            # MLflow refuses other characters in names.
            named_values = {re.sub(r"[^\w.: /-]", "_", key): value for key, value in known_numbers(line).items()}
            numbers = [self.metric(name, value, now_ms, line["step"]) for name, value in named_values.items()]
            self.client.log_batch(self.runs[seed], metrics=numbers)

    def on_stop(self) -> None:
        _close_all(partial(self.client.set_terminated, run) for run in self.runs.values())
