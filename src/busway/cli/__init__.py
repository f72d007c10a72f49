"""The command line: one file for each command of ``busway``, such as ``read``, ``serve`` and ``gateway``.

==================  ====================================================================================================
`arguments`         Options that several commands share, and the conversion of their texts to checked values
`captures`          What commands that read capture files share: options, opening, warnings of missing frames
`certs`             `busway certs`: makes certificates to try Modbus/TCP Security with, and shows what certificates say
`check`             `busway check`: checks a device against the specification, and reports where it differs
`cloning`           `busway simulate --clone`: records a live device into a simulation file
`collect`           `busway collect`: polls devices and stores their values, until Ctrl-C or SIGTERM
`collect_demo`      `busway collect demo`: a plant on a serial line, a gateway in front of it, a collector with its page
`collect_status`    Serves the page of a running collector and prints its status, for `busway collect` and fleets
`config`            `busway config`: explains a configuration file or its errors, and lists the options
`counters`          `busway counters`: shows the diagnostic counters of a device, read over Modbus
`decode`            `busway decode`: explains frames from a log, a manual or a capture file
`decode_capture`    `busway decode CAPTURE`: explains the Modbus frames of a capture file, field by field
`demo`              `busway demo`: a small plant on a serial line, a gateway in front of it, a client that polls it
`dissection`        Prints an explained frame: as lines, one for each field, or as a JSON object
`exits`             The exit codes of all commands, and which error ends with which code
`files`             Files that commands read; new files and capture files that they write
`fleet`             `busway fleet`: several collectors share the links of a plant, as a coordinator says
`fleet_demo`        `busway fleet demo`: 200 devices, three collectors that share them, and one of these is killed
`fleet_folder`      Which coordinator `busway fleet` asks: the named one, or a folder of this machine
`fleet_servers`     `busway fleet server-config`: configuration of NATS servers, and a secret for each role
`fleet_sinks`       `busway fleet run --stream` and `busway fleet sink`: samples of a zone through a stream of NATS
`fleet_write`       ``busway fleet write``: writes a value to a point of a zone by the collector that owns its link
`gateway`           `busway gateway`: forwards client requests to serial lines or other servers, until Ctrl-C or SIGTERM
`identify`          `busway identify`: shows how a device identifies itself
`output`            How commands print values on stdout: a table on a terminal, aligned lines elsewhere
`points`            `busway points`: converts descriptions of devices from other programs into device files
`policy`            `busway policy`: tells what a policy permits, and lists its rules, without a server
`program`           The program `busway`: loads the requested command, runs it, and ends with its exit code
`query`             `busway query`: prints samples from a store of the collector
`read`              `busway read`: shows values of a device, once or repeatedly
`read_points`       `busway read --points FILE`: reads the points of a device by name, in few requests
`reload_on_sighup`  SIGHUP while a service runs: its files are read again; on an error the old settings stay
`replay`            `busway replay`: reports conversations in a capture file and what was wrong; writes a simulation
`scan`              `busway scan`: finds the units that answer on a serial line, or behind an address
`sd_notify`         Tells systemd (sd_notify) that the program is ready, reloads, stops or is alive
`serve`             `busway serve`: serves one or several devices, until Ctrl-C or SIGTERM
`service_options`   Options that `busway serve`, `gateway` and `simulate` share, and what these print at the start
`signals`           Ctrl-C and SIGTERM end running commands; SIGHUP lets them read their files again
`simulate`          `busway simulate`: serves simulated devices whose values change as a file says
`sniff`             `busway sniff`: shows the traffic of a serial line. It listens and never sends
`sources`           Where the devices of `busway simulate` come from: a file, a ready-made device, or a register map
`status`            `busway status`: shows the status of a running server or gateway, over its control socket
`status_view`       Formats the status of a program as sections of rows, with words, times and sizes for people
`store`             `busway store`: checks, backs up and restores a store of the collector, also while it is written
`streams`           Standard input, output and error of a command: what happens if one is closed, full, or plain ASCII
`systemd_unit`      Generates the systemd unit file that runs a gateway
`write`             `busway write`: writes values to consecutive addresses of a device, in one request
==================  ====================================================================================================

One file per command. Of the whole package, only these files print anything; the others return values, raise and log.

Where it is decided: which exit code an error has: `exits`; what a command does after one of several reads has failed,
and with whose code it ends: `read`, `read_points`. How values are printed: `output`; status: `status_view`. What Ctrl-C
and SIGTERM do: `signals`. What SIGHUP does: `reload_on_sighup`; what changes then: `busway.apps.service.reload`,
`busway.apps.collector.reload`. How long requests in flight may take at the end of a gateway: `busway.options.gateway`
(``drain``). What happens when standard output is closed: `streams`. Which command is loaded: `program`. Options that
commands share: `arguments`.
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
    """Handle a failed import of the program: if an optional package is missing, end the process with code 2.

    The sentence on stderr names the command that installs the package. Any other import error is raised again.
    """
    from ..extras import missing_extra

    missing = missing_extra(error)
    if missing is None:
        raise error
    print(f"busway: {missing}", file=sys.stderr)
    sys.exit(2)
