"""The command line: ``busway read``, ``write``, ``identify``, ``scan``, ``counters``, ``serve``, ``sniff``, ``decode``,
``demo``.

One file per command. Only here are files and the environment read, and only here is anything printed.

==============  =======================================================================
`program`       the program: finds and loads a command, turns errors into exit codes
`exits`         the exit codes
`arguments`     what several commands take, and text → checked value
`output`        values as a table, aligned lines, JSON lines or CSV
`files`         files that people write, read once
`signals`       Ctrl-C and SIGTERM for commands that run until they are stopped
==============  =======================================================================
"""


def main() -> None:
    """Run the command that ``sys.argv`` names, and end the process with its exit code."""
    from .program import app  # here: `import busway.cli` alone costs nothing

    app(prog_name="busway")
