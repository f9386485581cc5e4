"""The command `lare-rl`, which is also `python -m lare_rl`."""

import sys

from lare_rl.errors import LareError


def main() -> None:
    """Run the command line. Its import registers plugins, whose errors are one line too."""
    try:
        from lare_rl import cli
    except LareError as error:
        if "--debug" in sys.argv[1:]:
            raise
        if sys.stderr is not None:  # it was closed by the caller
            sys.stderr.write(f"lare-rl: {error}\n")
        sys.exit(error.status)
    cli.main()


if __name__ == "__main__":
    main()
