"""A session is closed even if its environments cannot be."""

from concurrent.futures import Future, ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest

from lare_rl.errors import LareError
from lare_rl.training.session import Session


def test_close_reports_a_failed_checkpoint_after_an_error_of_the_environments():
    def fail():
        raise RuntimeError("a worker does not answer")

    saving: Future[None] = Future()
    saving.set_exception(LareError("No space left"))
    session: Any = Session.__new__(Session)  # without the run and the learner that a whole session needs
    vars(session).update(collector=SimpleNamespace(close=fail), _threads=ThreadPoolExecutor(1), _saving=saving)
    with pytest.raises(LareError, match="No space left") as error:
        session.close()
    assert isinstance(error.value.__context__, RuntimeError)
    with pytest.raises(RuntimeError, match="shutdown"):
        session._threads.submit(fail)
