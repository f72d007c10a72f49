"""Audit lines, as JSON, for commands that write points and for changes of the configuration.

Pure: knows what happened; writes nothing. `busway.access.audit_log` keeps the lines.

=================  ======================================================================================
of a command       meaning
=================  ======================================================================================
``time``           when it ended or was refused, UTC
``event``          ``command``
``by``, ``origin`` who gave it, and on which way it came: ``page``, ``api``, ``program``, ``mqtt``, ``nats``,
                   ``sparkplug``, ``fleet``
``key``            the name of the command
``device``,
``point``          the point to write
``old``            the last known value of the point before the command; null if none was known
``new``            the value of the command
``outcome``        ``done``, ``failed``, ``unknown``, ``expired``, ``refused``
``read_back``      what the device showed afterwards; null if the point was not read back
``reason``         why it is not done, or a remark; empty if there is nothing to say
``repeated``       only in lines of repeated refusals that the journal does not keep: how many the line stands for
=================  ======================================================================================

=================  ======================================================================================
of a configuration meaning
=================  ======================================================================================
``time``           when it was changed or refused, UTC
``event``          ``configuration``
``by``, ``origin`` who changed it, and how: ``api``, ``signal``, ``program``, ``fleet``
``outcome``        ``applied`` or ``refused``
``revision``       of the new text: the first 16 hexadecimal digits of its SHA-256; ``before`` that of the old one
``difference``     lines that differ (unified diff), ``LONGEST_DIFFERENCE`` at most; ``more`` counts the others
``done``           what changed, or everything that is wrong, as sentences, ``LONGEST_DIFFERENCE`` at most
=================  ======================================================================================
"""

import difflib
import hashlib
import json
from collections.abc import Sequence
from typing import Any, Final

from .command import CommandResult

LONGEST_DIFFERENCE: Final = 200
_LONGEST_LINE: Final = 300


def command_line(result: CommandResult, time: str, repeated: int = 0) -> str:
    """Return the line of the audit log for a finished or refused command.

    Args:
        result: the result of the command.
        time: when it ended or was refused, UTC, as text.
        repeated: for a line that stands for several refusals with the same origin, writer and device that got no line
            of their own: how many; 0 for a line about one command.
    """
    command = result.command
    more = {"repeated": repeated} if repeated else {}
    return _line(
        {
            "time": time,
            "event": "command",
            "by": command.by,
            "origin": command.origin,
            "key": command.key,
            "device": command.device,
            "point": command.point,
            "old": None if result.old is None else result.old.value,
            "new": command.value,
            "outcome": result.state.value,
            "read_back": result.read_back,
            "reason": result.reason,
            **more,
        }
    )


def configuration_line(
    old: str, new: str, done: Sequence[str], *, is_applied: bool, by: str, origin: str, time: str
) -> str:
    """Return the line of the audit log for a change of the configuration.

    Args:
        old, new: the present text of the configuration file, and the text that is to replace it.
        done: what changed, or everything that is wrong, as sentences. The line has the first `LONGEST_DIFFERENCE`, each
            cut to 300 characters.
        is_applied: whether the new text was applied; else it was refused.
        by, origin: who changed it, and how: ``api``, ``signal``, ``program`` or ``fleet``.
        time: when, UTC, as text.
    """
    lines = [
        each.rstrip("\n")[:_LONGEST_LINE]
        for each in difflib.unified_diff(old.splitlines(), new.splitlines(), "before", "after", n=0, lineterm="")
    ]
    return _line(
        {
            "time": time,
            "event": "configuration",
            "by": by,
            "origin": origin,
            "outcome": "applied" if is_applied else "refused",
            "revision": revision_of(new),
            "before": revision_of(old),
            "difference": lines[:LONGEST_DIFFERENCE],
            "more": max(len(lines) - LONGEST_DIFFERENCE, 0),
            "done": [each[:_LONGEST_LINE] for each in done[:LONGEST_DIFFERENCE]],
        }
    )


def revision_of(text: str) -> str:
    """Return the revision of a configuration: the first 16 hexadecimal digits of the SHA-256 of its text."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _line(content: dict[str, Any]) -> str:  # JSON
    return json.dumps(content, ensure_ascii=True) + "\n"
