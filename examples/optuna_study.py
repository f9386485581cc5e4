"""Optuna tunes TD3 on one task, and prunes trials that are worse than the median of the trials before them.

pip install optuna
python examples/optuna_study.py
"""

import optuna

import lare_rl
from lare_rl.training.progress import Listener


class Report(Listener):
    """Reports the mean return over the seeds after each evaluation."""

    def __init__(self, trial: optuna.Trial):
        self.trial, self.value = trial, float("nan")

    def on_evaluation(self, metrics):
        self.value = sum(line["evaluation/return"] for line in metrics) / len(metrics)
        self.trial.report(self.value, step=metrics[0]["step"])
        if self.trial.should_prune():
            raise optuna.TrialPruned


def main(n_trials: int = 20, steps: int = 60_000, warmup: int = 10_000, out: str = "runs/optuna", **changes):
    """Return the study. `changes` are other settings of each run."""

    def objective(trial: optuna.Trial) -> float:
        gamma, tau = trial.suggest_float("gamma", 0.95, 0.999), trial.suggest_float("tau", 1e-3, 2e-2, log=True)
        settings = lare_rl.Settings(steps=steps, td3={"gamma": gamma, "tau": tau, "warmup": warmup}, **changes)
        report = Report(trial)
        lare_rl.train("Reacher-v4", settings, out=f"{out}/{trial.number}", listeners=[report])
        return report.value

    study = optuna.create_study(direction="maximize", pruner=optuna.pruners.MedianPruner(n_warmup_steps=warmup))
    study.optimize(objective, n_trials)
    return study


if __name__ == "__main__":
    print(main().best_params)
