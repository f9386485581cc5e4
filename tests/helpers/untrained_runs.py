"""Run directories without training."""

import json

from lare_rl.runs.config_file import make_config


def write_run(directory, task, settings, metrics):
    """Write the files of a run that has these lines of metrics, and return its configuration."""
    directory.mkdir(parents=True)
    config = make_config(task, settings, ())
    (directory / "config.json").write_text(config.model_dump_json())
    (directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in metrics))
    return config
