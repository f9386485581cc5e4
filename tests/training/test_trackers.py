"""Metrics in Weights & Biases and MLflow, without a network."""

import builtins

import pytest

from helpers.toy_envs import toy_spec
from helpers.training_runs import train_quietly
from lare_rl.errors import LareError
from lare_rl.training.trackers import MLflow, WeightsAndBiases


def numbers_by_step(run, seed):
    """Return the metrics of a seed in metrics.jsonl."""
    return {
        line["step"]: {key: value for key, value in line.items() if key not in ("step", "seed") and value is not None}
        for line in run.metrics()
        if line["seed"] == seed
    }


def test_mlflow_gets_every_number(small, tmp_path, monkeypatch):
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    uri = (tmp_path / "mlruns").as_uri()
    listener = MLflow("toys", uri, {"method": "rrdu"})
    run = train_quietly(toy_spec(), small(method="rrdu", steps=120), tmp_path / "run", listeners=[listener])
    assert MLflow("toys", uri).experiment == listener.experiment
    assert sorted(listener.runs) == [0, 1]
    for seed, run_id in listener.runs.items():
        tracked = listener.client.get_run(run_id)
        assert (tracked.info.run_name, tracked.info.status) == (f"Chase rrdu seed {seed}", "FINISHED")
        assert tracked.data.params == {"method": "rrdu"}
        expected = numbers_by_step(run, seed)
        assert set(tracked.data.metrics) == set().union(*expected.values())
        for key in tracked.data.metrics:
            history = {point.step: point.value for point in listener.client.get_metric_history(run_id, key)}
            assert history == {step: line[key] for step, line in expected.items() if key in line}


def test_wandb_gets_every_number(small, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_SILENT", "true")
    listener = WeightsAndBiases(project="toys", mode="offline", dir=tmp_path)
    logged, init = [], listener.init

    def init_and_record(**arguments):
        run = init(**arguments)
        log = run.log
        monkeypatch.setattr(
            run, "log", lambda line, step: logged.append((arguments["name"], step, line)) or log(line, step=step)
        )
        return run

    listener.init = init_and_record
    run = train_quietly(toy_spec(), small(method="rrdu", steps=120), tmp_path / "run", listeners=[listener])
    for seed in (0, 1):
        numbers = {step: line for name, step, line in logged if name == f"Chase rrdu seed {seed}"}
        assert numbers == numbers_by_step(run, seed)
    assert len(list(tmp_path.glob("wandb/offline-run-*/*.wandb"))) == 2


@pytest.mark.parametrize(("listener", "library"), [(WeightsAndBiases, "wandb"), (MLflow, "mlflow")])
def test_missing_library(listener, library, monkeypatch):
    real_import = builtins.__import__

    def import_without_library(name, *args, **kwargs):
        if name.partition(".")[0] == library:
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", import_without_library)
    with pytest.raises(LareError, match=rf"needs an extra: .*\[{library}\]"):
        listener()


def test_unusable_tracking_server():
    with pytest.raises(LareError, match=r"MLflow cannot be used: .*nowhere"):
        MLflow(tracking_uri="nowhere://")
