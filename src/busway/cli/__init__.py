"""The command line: one file for each command of ``busway``, such as ``read``, ``serve`` and ``gateway``.

One file per command. Only here are files and the environment read, and only here is anything printed.

==============  =======================================================================
`program`       the program: finds and loads a command, turns errors into exit codes
`exits`         the exit codes
`arguments`     what several commands take, and text → checked value
`output`        values as a table, aligned lines, JSON lines or CSV
`files`         files that people write, read once
`streams`       stdout, stderr and stdin where they are full, closed or plain ASCII
`signals`       Ctrl-C and SIGTERM for commands that run until they are stopped
==============  =======================================================================
"""

import sys
from typing import NoReturn


def main() -> None:
    """Run the command that ``sys.argv`` names, and end the process with its exit code."""
    try:
        from .program import app  # here: `import busway.cli` alone costs nothing
    except ImportError as error:
        _refuse(error)
    app(prog_name="busway")


def _refuse(error: ImportError) -> NoReturn:
    """End the process with code 2 and the command that installs a missing package; re-raise other errors."""
    from ..extras import missing_extra

    missing = missing_extra(error)
    if missing is None:
        raise error
    print(f"busway: {missing}", file=sys.stderr)
    sys.exit(2)
