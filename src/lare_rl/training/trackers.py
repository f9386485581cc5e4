"""Listeners that send metrics.jsonl to a tracking service. Each seed becomes a separate run of the service.

    lare_rl.train(task, settings, listeners=[Terminal(), WeightsAndBiases(project="cheetah")])

The service's own settings decide where it stores them, and whether it is reached at all (`WANDB_MODE=offline`,
`MLFLOW_TRACKING_URI`). A resumed run continues in new runs of the service, from the step of its checkpoint.
"""

import time
from collections.abc import Mapping
from typing import Any

from lare_rl.errors import LareError, needs_extra
from lare_rl.training.progress import Metrics


class WeightsAndBiases:
    """Sends every number to Weights & Biases, with the extra `lare-rl[wandb]`."""

    def __init__(self, **arguments: Any):
        """Arguments are those of `wandb.init`: project, group, config, mode, dir, ... Raises `LareError` if wandb is missing."""
        try:
            import wandb
        except ImportError:
            raise needs_extra("Weights & Biases", "wandb") from None
        self.init, self.arguments, self.name = wandb.init, arguments, ""
        self.runs: dict[int, Any] = {}
        """The service's runs, by seed."""

    def started(self, name: str, step: int, steps: int) -> None:
        self.name = name

    def stepped(self, step: int) -> None: ...
    def said(self, message: str) -> None: ...

    def evaluated(self, metrics: Metrics) -> None:
        for line in metrics:
            seed = line["seed"]
            if seed not in self.runs:
                given: dict[str, Any] = {"name": f"{self.name} seed {seed}", "group": self.name} | self.arguments
                self.runs[seed] = self.init(reinit="create_new", **given)
            self.runs[seed].log(numbers(line), step=line["step"])

    def stopped(self) -> None:
        for run in self.runs.values():
            run.finish()


class MLflow:
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
            LareError: mlflow is missing, or the tracking server or directory cannot be used.
        """
        try:
            from mlflow import MlflowClient
            from mlflow.entities import Metric, Param
            from mlflow.exceptions import MlflowException
        except ImportError:
            raise needs_extra("MLflow", "mlflow") from None
        self.metric = Metric
        self.parameters = [Param(key, str(value)) for key, value in (parameters or {}).items()]
        try:
            self.client = MlflowClient(tracking_uri)
            known = self.client.get_experiment_by_name(experiment)
            self.experiment = known.experiment_id if known else self.client.create_experiment(experiment)
        except MlflowException as error:
            raise LareError(f"MLflow cannot be used: {error}") from error
        self.name = ""
        self.runs: dict[int, str] = {}
        """The service's runs, by seed."""

    def started(self, name: str, step: int, steps: int) -> None:
        self.name = name

    def stepped(self, step: int) -> None: ...
    def said(self, message: str) -> None: ...

    def evaluated(self, metrics: Metrics) -> None:
        now = int(1000 * time.time())
        for line in metrics:
            seed = line["seed"]
            if seed not in self.runs:
                made = self.client.create_run(self.experiment, run_name=f"{self.name} seed {seed}")
                self.runs[seed] = made.info.run_id
                self.client.log_batch(self.runs[seed], params=self.parameters)
            found = [self.metric(key, value, now, line["step"]) for key, value in numbers(line).items()]
            self.client.log_batch(self.runs[seed], metrics=found)

    def stopped(self) -> None:
        for run in self.runs.values():
            self.client.set_terminated(run)


def numbers(line: Mapping[str, Any]) -> dict[str, float]:
    """The measured numbers of a line of metrics.jsonl."""
    return {key: value for key, value in line.items() if key not in ("step", "seed") and value is not None}
