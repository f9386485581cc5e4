"""Metrics in Weights & Biases and MLflow, without a network."""

import builtins

import pytest

import lare_rl
from helpers.toys import toy_spec
from lare_rl.errors import LareError, pip_install
from lare_rl.training.trackers import MLflow, WeightsAndBiases


def trained(small, listener, out):
    return lare_rl.train(toy_spec(), small(method="rrdu", steps=120), out=out, listeners=[listener])


def numbers_of(run, seed):
    """What metrics.jsonl has of a seed, by step."""
    return {
        line["step"]: {key: value for key, value in line.items() if key not in ("step", "seed") and value is not None}
        for line in run.metrics()
        if line["seed"] == seed
    }


def test_mlflow_has_every_number_of_every_seed(small, tmp_path, monkeypatch):
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    uri = (tmp_path / "mlruns").as_uri()
    listener = MLflow("toys", uri, {"method": "rrdu"})
    run = trained(small, listener, tmp_path / "run")
    assert MLflow("toys", uri).experiment == listener.experiment
    for seed, name in listener.runs.items():
        found = listener.client.get_run(name)
        assert (found.info.run_name, found.info.status) == (f"Chase rrdu seed {seed}", "FINISHED")
        assert found.data.params == {"method": "rrdu"}
        wanted = numbers_of(run, seed)
        for key in found.data.metrics:
            history = {one.step: one.value for one in listener.client.get_metric_history(name, key)}
            assert history == {step: line[key] for step, line in wanted.items() if key in line}
        assert set(found.data.metrics) == set().union(*wanted.values())
    assert sorted(listener.runs) == [0, 1]


def test_wandb_has_every_number_of_every_seed(small, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_SILENT", "true")
    listener = WeightsAndBiases(project="toys", mode="offline", dir=tmp_path)
    logged = []
    begin = listener.init

    def init(**given):
        made = begin(**given)
        send = made.log
        monkeypatch.setattr(
            made, "log", lambda line, step: logged.append((given["name"], step, line)) or send(line, step=step)
        )
        return made

    listener.init = init
    run = trained(small, listener, tmp_path / "run")
    for seed in (0, 1):
        found = {step: line for name, step, line in logged if name == f"Chase rrdu seed {seed}"}
        assert found == numbers_of(run, seed)
    assert len(list(tmp_path.glob("wandb/offline-run-*/*.wandb"))) == 2


@pytest.mark.parametrize(
    ("listener", "library", "message"),
    [
        (WeightsAndBiases, "wandb", f"Weights & Biases needs an extra: {pip_install('wandb')}"),
        (MLflow, "mlflow", f"MLflow needs an extra: {pip_install('mlflow')}"),
    ],
)
def test_a_library_that_is_missing_is_one_line(listener, library, message, monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **named):
        if name.partition(".")[0] == library:
            raise ImportError(name)
        return real(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(LareError) as raised:
        listener()
    assert str(raised.value) == message


def test_a_tracking_server_that_cannot_be_used_is_one_line(tmp_path):
    with pytest.raises(LareError, match=r"MLflow cannot be used: .*nowhere"):
        MLflow(tracking_uri="nowhere://")
