"""Files that are replaced as a whole."""

import pytest

from lare_rl.errors import LareError
from lare_rl.util.files import write_atomically


@pytest.mark.parametrize(
    ("error", "expected"),
    [(OSError(28, "No space left on device"), LareError), (KeyboardInterrupt(), KeyboardInterrupt)],
)
def test_failed_write_keeps_the_old_file(tmp_path, error, expected):
    def write(file):
        file.write(b"half")
        raise error

    path = tmp_path / "table.csv"
    path.write_bytes(b"old")
    with pytest.raises(expected, match="No space left" if expected is LareError else None):
        write_atomically(path, write)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("table.csv", b"old")]


def test_two_writers(tmp_path):
    path = tmp_path / "table.csv"

    def write(file):
        file.write(b"first")
        write_atomically(path, lambda other: other.write(b"second"))
        file.write(b" and last")

    write_atomically(path, write)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("table.csv", b"first and last")]
