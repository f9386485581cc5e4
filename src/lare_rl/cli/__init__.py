"""The command line. Each command is one function; its arguments are its options, and tyro writes the help.

Modules that are slow to import are imported inside the command that needs them.
"""

import contextlib
import io
import os
import sys
import traceback

from lare_rl.cli.design import design
from lare_rl.cli.functions import new_task, prompt, verify
from lare_rl.cli.lists import algorithms, methods, tasks
from lare_rl.cli.logs import relabel
from lare_rl.cli.parse import parse
from lare_rl.cli.runs import cross_play, evaluate, export, report
from lare_rl.cli.studies import compare, reproduce, sweep
from lare_rl.cli.terminal import discard_output, print_line, print_progress
from lare_rl.cli.train import train
from lare_rl.cli.turns import turn_credit, turn_phi
from lare_rl.errors import LareError
from lare_rl.util import compilation
from lare_rl.util.provenance import code_version
from lare_rl.util.sanitize import one_line

DESCRIPTION = (
    "LaRe: a reward for every step, from one number per episode. "
    "lare-rl --version prints the version of the code; --debug, with any command, prints the traceback of an error."
)
COMMANDS = {
    "tasks": tasks,
    "methods": methods,
    "algorithms": algorithms,
    "new-task": new_task,
    "prompt": prompt,
    "design": design,
    "verify": verify,
    "relabel": relabel,
    "turn-credit": turn_credit,
    "turn-phi": turn_phi,
    "train": train,
    "evaluate": evaluate,
    "sweep": sweep,
    "report": report,
    "export": export,
    "compare": compare,
    "cross-play": cross_play,
    "reproduce": reproduce,
}


def main() -> None:
    """Run `lare-rl`. A user's mistake is one line on stderr and the error's exit status; --debug prints its traceback too."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # it was closed by the caller
            stream = open(os.devnull, "w")  # noqa: SIM115 - it stays open
            os.set_inheritable(stream.fileno(), True)  # for processes that are started
            setattr(sys, name, stream)
    for stream in (sys.stdout, sys.stderr):  # a character that the terminal cannot show must raise no error
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    debug = len(arguments) < len(sys.argv) - 1
    try:
        if arguments == ["--version"]:
            print_line(code_version())
        else:
            command = parse(COMMANDS, DESCRIPTION, arguments)
            os.environ.update(compilation.cache_variables(os.environ))  # JAX reads them when a command imports it
            command()
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        discard_output(sys.stdout)
        sys.exit(1)
    except (LareError, OSError) as error:
        if debug:
            traceback.print_exc()
        print_progress(f"lare-rl: {one_line(error)}")
        if isinstance(error, LareError):
            sys.exit(error.status)
        with contextlib.suppress(OSError):  # it may be stdout that failed: Python would write to it again at exit
            discard_output(sys.stdout)
        sys.exit(2)
