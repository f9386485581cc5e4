"""Run directories without training, and runs that were not trained."""

import json

from helpers.toy_envs import toy_spec
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.runs.config_file import make_config
from lare_rl.runs.directory import create_run
from lare_rl.training.session import start_session

LINE = {"step": 1, "seed": 0, "evaluation/return": 1.5}
"""An evaluation."""


def write_run(directory, task, settings, metrics, functions=()):
    """Write the files of a run that has these lines of metrics, and return its configuration."""
    directory.mkdir(parents=True)
    config = make_config(task, settings, functions)
    (directory / "config.json").write_text(config.model_dump_json())
    (directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in metrics))
    return config


def invent_training(find_metrics):
    """Return a function that writes metrics instead of training a job: those of a job and a seed, at two steps."""

    def train(job, *_):
        steps = (job.resolved.steps // 2, job.resolved.steps)
        seeds = job.resolved.all_seeds
        metrics = [{"step": step, "seed": seed, **find_metrics(job, seed)} for step in steps for seed in seeds]
        write_run(job.directory, job.task, job.resolved, metrics)

    return train


def untrained_run(task, settings, directory):
    """Return a run whose checkpoint is from before its first step: nothing of its training is compiled."""
    session = start_session(create_run(directory, task, resolve(settings, task), ()))
    session.save()
    session.close()
    return session.run


def write_changed_run(directory, **changes):
    """Write the files of a run of the toy, with changes of its config.json and one evaluation, and return its directory."""
    config = make_config(toy_spec(), resolve(Settings(method="dense", steps=100), toy_spec()), ())
    (directory / "config.json").write_text(json.dumps(json.loads(config.model_dump_json()) | changes))
    (directory / "metrics.jsonl").write_text(json.dumps(LINE) + "\n")
    return directory
