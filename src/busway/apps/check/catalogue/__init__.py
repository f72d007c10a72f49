"""The checks: made for a target, in the order in which they run.

=============  ==========================================================================
`basics`       The basic checks: what every reply has to be, one facet each
`reads`        Checks of the functions that read: 01 to 04, 07, 11, 12, 17, 20, 24 and 43
`diagnostics`  Checks of diagnostics (08) and of functions that do not exist
`writes`       Checks of the functions that write: 05, 06, 15, 16, 22 and 23
`streams`      Checks of the stream of Modbus on TCP/IP and of connections
`handshakes`   Checks of Modbus/TCP Security: connections that must not lead to an answer
`lines`        Checks of serial lines: damaged frames, other units, broadcasts
`shorthand`    Short ways to write checks: what is accepted, and PDUs from numbers
=============  ==========================================================================

Where it is decided: what is sent and what is accepted: the file of the subject, such as `reads`. In which order checks
run: here. What is a basic check: `basics`.
"""

from collections.abc import Collection

from ....errors import ConfigError
from ..check import Check, Level, Target
from ..run import probe_of
from .basics import basic_checks
from .diagnostics import diagnostic_checks
from .handshakes import handshake_checks
from .lines import line_checks
from .reads import read_checks
from .streams import stream_checks
from .writes import write_checks


def checks_for(target: Target, level: Level, only: Collection[str] = ()) -> list[Check]:
    """Return the checks to run against a target, in the order in which they run.

    The basic checks come first, then the others by level, from ``READ`` to ``DISRUPTIVE``.

    Args:
        target: the device to be checked; its framing, items and TLS decide which checks there are.
        level: the highest level; checks of higher levels are left out.
        only: names of clauses or checks to keep; empty keeps all. Basic checks are always kept.

    Raises:
        ConfigError: a name in ``only`` is neither a clause nor a check that exists for this target.
    """
    probe, longer = probe_of(target), probe_of(target, 2)
    checks = basic_checks(target, probe) + read_checks(target)
    checks += stream_checks(target, probe) if target.framing == "mbap" else line_checks(target, probe, longer)
    checks += handshake_checks(probe) if target.is_secure else []
    checks += diagnostic_checks(target) + write_checks(target)
    known = {name for one in checks for name in (one.id, one.clause)}
    unknown = sorted(set(only) - known)
    if unknown:
        raise ConfigError(f"no check and no clause is named {unknown[0]}", key="--only")
    wanted = [one for one in checks if one.facet is not None or not only or {one.id, one.clause} & set(only)]
    return sorted((one for one in wanted if one.level <= level), key=lambda one: (one.facet is None, one.level))
