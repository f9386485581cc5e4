"""The outer loop, with a session that does nothing: what it reports, and what is closed after an error."""

import threading
import time

import pytest

from helpers.listeners import MessageListener
from helpers.toy_envs import toy_spec
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.errors import LareError
from lare_rl.runs.config_file import make_config
from lare_rl.runs.directory import Run
from lare_rl.training import session as sessions
from lare_rl.training import train as training
from lare_rl.training.decoder_fits import FirstFitStoppedError
from lare_rl.training.session import Session


class EmptySession(Session):
    clock = evaluation_s = save_s = 0.0
    is_closed = False

    def __init__(self, directory, **attributes):
        settings = Settings(method="dense", steps=36, rollout_steps=12, evaluate_every=12, evaluation_episodes=1)
        self.run = Run(directory, make_config(toy_spec(), resolve(settings, toy_spec()), ()), ())
        self.latest_metrics = {}
        vars(self).update(attributes)

    def watch(self, on_step, stop_requested):
        pass

    def advance(self, until):
        self.step = until
        self.clock += 1.0

    def evaluate(self, rate):
        self.clock += self.evaluation_s
        return [{"step": self.step, "seed": 0, "evaluation/return": 1.0}]

    def save(self):
        self.clock += self.save_s

    def close(self):
        self.is_closed = True


class Recorder(MessageListener):
    def __init__(self, fails=False):
        super().__init__()
        self.fails, self.n_stops = fails, 0

    def on_stop(self):
        self.n_stops += 1
        if self.fails:
            raise OSError("disk full")


@pytest.fixture(autouse=True)
def no_files(monkeypatch):
    monkeypatch.setattr(training, "append_metrics", lambda directory, lines: 0)
    monkeypatch.setattr(training, "_final_findings", lambda run, lines: [])


@pytest.mark.parametrize(("seconds", "is_slow"), [({"save_s": 9.0}, False), ({"evaluation_s": 9.0}, True)])
def test_time_of_an_evaluation_has_no_checkpoint_in_it(seconds, is_slow, tmp_path, monkeypatch):
    listener, session = Recorder(), EmptySession(tmp_path, **seconds)
    monkeypatch.setattr(time, "monotonic", lambda: session.clock)
    training.run_session(session, [listener], threading.Event())
    assert any("--evaluation-episodes" in message for message in listener.messages) == is_slow


def test_first_fit_that_is_stopped_is_not_kept(tmp_path):
    def stop(until):
        raise FirstFitStoppedError

    with pytest.raises(training.RunInterruptedError, match=r"nothing is kept.*--resume"):
        training.run_session(EmptySession(tmp_path, advance=stop), [], threading.Event())


def test_every_listener_is_stopped(tmp_path, monkeypatch):
    listeners = [Recorder(fails=True), Recorder(), Recorder(fails=True)]
    session = EmptySession(tmp_path)
    monkeypatch.setattr(training, "start_session", lambda run: session)
    with pytest.raises(OSError, match="disk full"):
        training._run_to_end(session.run, False, listeners, threading.Event(), [], 36)
    assert session.is_closed
    assert [listener.n_stops for listener in listeners] == [1, 1, 1]


@pytest.mark.parametrize(
    ("error", "message"),
    [(LareError("best.npz is damaged"), "best.npz"), (KeyError("state"), "does not fit"), (KeyboardInterrupt(), None)],
)
def test_session_that_cannot_be_restored_is_closed(error, message, tmp_path, monkeypatch):
    def restore(metadata, arrays):
        raise error

    session = EmptySession(tmp_path, restore=restore)
    monkeypatch.setattr(sessions, "load_learner", lambda run, n_devices: (None, None, {}, {}))
    monkeypatch.setattr(sessions, "_make_session", lambda run, config, learner: session)
    with pytest.raises(KeyboardInterrupt if message is None else LareError, match=message):
        sessions.restore_session(session.run)
    assert session.is_closed
