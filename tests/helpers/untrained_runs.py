"""Run directories without training."""

import json

import pytest

from helpers.toy_envs import toy_spec
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.runs.config_file import make_config
from lare_rl.runs.directory import Run


@pytest.fixture
def make_run(tmp_path):
    """Return a function that writes a run directory: configuration and metrics."""

    def make(name, returns, task="Chase", steps=(50, 100), method="dense", **changes):
        spec = toy_spec(name=task)
        settings = resolve(Settings(method=method, steps=100, seeds=len(returns), **changes), spec)
        directory = tmp_path / "runs" / task / name
        directory.mkdir(parents=True)
        config = make_config(spec, settings, ())
        (directory / "config.json").write_text(config.model_dump_json())
        lines = [
            {"step": step, "seed": seed, "evaluation/return": value * index / len(steps), "critic/loss": 1.0}
            for index, step in enumerate(steps, 1)
            for seed, value in zip(settings.all_seeds, returns, strict=True)
        ]
        (directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        return Run(directory, config, ())

    return make
