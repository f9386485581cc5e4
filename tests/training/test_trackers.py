"""Metrics in Weights & Biases and MLflow, without a network."""

import sys
from itertools import groupby

import pytest

from lare_rl.errors import LareError
from lare_rl.training.trackers import MLflow, WeightsAndBiases


def send_metrics(listener, run):
    """Send the metrics of a finished run as if it trained. Return the numbers of each seed by step."""
    listener.on_start("Chase dense", 0, 240)
    for _, lines in groupby(run.metrics(), key=lambda line: line["step"]):
        listener.on_evaluation(list(lines))
    listener.on_stop()
    numbers = {seed: {} for seed in run.seeds}
    for line in run.metrics():
        names = {name for name, value in line.items() if value is not None} - {"step", "seed"}
        numbers[line["seed"]][line["step"]] = {name: line[name] for name in names}
    return numbers


def test_mlflow_gets_every_number(dense_run, tmp_path, monkeypatch):
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    uri = (tmp_path / "mlruns").as_uri()
    listener = MLflow("toys", uri, {"method": "dense"})
    numbers = send_metrics(listener, dense_run)
    assert MLflow("toys", uri).experiment == listener.experiment
    assert sorted(listener.runs) == [0, 1]
    for seed, run_id in listener.runs.items():
        tracked, expected = listener.client.get_run(run_id), numbers[seed]
        assert (tracked.info.run_name, tracked.info.status) == (f"Chase dense seed {seed}", "FINISHED")
        assert tracked.data.params == {"method": "dense"}
        assert set(tracked.data.metrics) == set().union(*expected.values())
        for key in tracked.data.metrics:
            history = {point.step: point.value for point in listener.client.get_metric_history(run_id, key)}
            assert history == {step: line[key] for step, line in expected.items() if key in line}
    first_runs = listener.runs
    listener.on_start("Chase dense", 0, 240)
    listener.on_evaluation(dense_run.metrics()[-2:])
    assert set(first_runs.values()).isdisjoint(listener.runs.values())  # another training has other runs


def test_failing_service_is_a_warning(dense_run, tmp_path, monkeypatch):
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    listener = MLflow("toys", (tmp_path / "mlruns").as_uri())
    lines = [line | {"evaluation/a[0]": 1.0} for line in dense_run.metrics()[:2]]
    listener.on_start("Chase dense", 0, 240)
    listener.on_evaluation(lines[:1])
    assert "evaluation/a_0_" in listener.client.get_run(listener.runs[0]).data.metrics
    monkeypatch.setattr(listener, "metric", "no class")
    with pytest.warns(RuntimeWarning, match=r"MLflow .*not callable.*metrics\.jsonl"):
        listener.on_evaluation(lines)
    n_runs = len(listener.runs)
    listener.on_evaluation(lines)  # without another warning
    listener.on_stop()
    assert len(listener.runs) == n_runs
    assert {listener.client.get_run(run).info.status for run in listener.runs.values()} == {"FINISHED"}
    listener.on_start("Chase dense", 0, 240)  # another training tries again
    with pytest.warns(RuntimeWarning):
        listener.on_evaluation(lines)


@pytest.mark.long
def test_wandb_gets_every_number(dense_run, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_SILENT", "true")
    listener = WeightsAndBiases(project="toys", mode="offline", dir=tmp_path)
    logged, init = [], listener.init

    def init_and_record(**arguments):
        run = init(**arguments)
        record, log = (lambda line, step: logged.append((arguments["name"], step, line))), run.log
        monkeypatch.setattr(run, "log", lambda line, step: record(line, step) or log(line, step=step))
        return run

    listener.init = init_and_record
    for seed, numbers in send_metrics(listener, dense_run).items():
        assert {step: line for name, step, line in logged if name == f"Chase dense seed {seed}"} == numbers
    assert len(list(tmp_path.glob("wandb/offline-run-*/*.wandb"))) == 2


def test_missing_library_and_unusable_arguments(monkeypatch):
    with pytest.raises(LareError, match=r"MLflow cannot be used: .*nowhere"):
        MLflow(tracking_uri="nowhere://")
    with pytest.raises(LareError, match=r"wandb.init .*'projekt'"):
        WeightsAndBiases(projekt="toys")
    for listener, library in ((WeightsAndBiases, "wandb"), (MLflow, "mlflow")):
        monkeypatch.setitem(sys.modules, library, None)
        with pytest.raises(LareError, match=rf"needs an extra: .*\[{library}\]"):
            listener()
