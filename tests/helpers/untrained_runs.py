"""Runs that were never trained, for what is made of finished ones."""

import json

import pytest

from helpers.toys import toy_spec
from lare_rl.config.resolve import decide
from lare_rl.config.settings import Settings
from lare_rl.runs.directory import Run, describe


@pytest.fixture
def made(tmp_path):
    """Makes a run directory: configuration and metrics, nothing trained."""

    def make(name, returns, task="Chase", steps=(50, 100), method="dense", **given):
        spec = toy_spec(name=task)
        settings = decide(Settings(method=method, steps=100, seeds=len(returns), **given), spec)
        directory = tmp_path / "runs" / task / name
        directory.mkdir(parents=True)
        config = describe(spec, settings, ())
        (directory / "config.json").write_text(config.model_dump_json())
        lines = [
            {"step": step, "seed": seed, "evaluation/return": value * place / len(steps), "critic/loss": 1.0}
            for place, step in enumerate(steps, 1)
            for seed, value in zip(settings.all_seeds, returns, strict=True)
        ]
        (directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        return Run(directory, config, ())

    return make
