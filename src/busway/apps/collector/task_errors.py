"""Handles errors with which tasks end: takes the error out of a group of errors, and writes it to the log.

A task group of asyncio raises a group of errors whose text is only "unhandled errors in a TaskGroup".
"""

import asyncio
import logging

_log = logging.getLogger("busway.collector")


def first_error(group: ExceptionGroup[Exception]) -> Exception:
    """Return the first error in a group of errors, also if it is in a group inside the group.

    Each of the other errors is added to it as a note.
    """
    first, *others = _errors_of(group)
    for other in others:
        first.add_note(f"another task ended at the same time by {type(other).__name__}: {other}")
    return first


def _errors_of(group: ExceptionGroup[Exception]) -> list[Exception]:
    found: list[Exception] = []
    for each in group.exceptions:
        found += _errors_of(each) if isinstance(each, ExceptionGroup) else [each]
    return found


def log_defect(task: asyncio.Task[None]) -> None:
    """Log the error with which a task has ended, if any; a done callback for tasks that should never fail."""
    if not task.cancelled() and task.exception() is not None:
        _log.error("%s ended unexpectedly", task.get_name(), exc_info=task.exception())
