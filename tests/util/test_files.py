"""Files are replaced as a whole, whatever happens in between."""

import pytest

from lare_rl.errors import LareError
from lare_rl.util.files import write_atomically


def failing(file):
    file.write(b"half")
    raise OSError(28, "No space left on device")


def test_what_cannot_be_written_leaves_what_was_there(tmp_path):
    path = tmp_path / "table.csv"
    path.write_bytes(b"whole")
    with pytest.raises(
        LareError, match=r"table\.csv cannot be written \(No space left on device\); an existing file is unchanged"
    ):
        write_atomically(path, failing)
    assert [(one.name, one.read_bytes()) for one in tmp_path.iterdir()] == [("table.csv", b"whole")]


def test_two_at_a_time_do_not_meet(tmp_path):
    path = tmp_path / "table.csv"

    def while_another(file):
        file.write(b"first")
        write_atomically(path, lambda other: other.write(b"second"))
        file.write(b" and whole")

    write_atomically(path, while_another)
    assert [(one.name, one.read_bytes()) for one in tmp_path.iterdir()] == [("table.csv", b"first and whole")]


def test_who_is_interrupted_leaves_nothing_behind(tmp_path):
    def interrupted(file):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "table.csv", interrupted)
    assert not list(tmp_path.iterdir())
