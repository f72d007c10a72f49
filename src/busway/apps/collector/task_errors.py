"""Errors with which tasks end: the error inside a group of errors, and the line in the log.

A task group of asyncio raises a group whose text is only "unhandled errors in a TaskGroup".
"""

import asyncio
import logging

_log = logging.getLogger("busway.collector")


def first_error(group: ExceptionGroup[Exception]) -> Exception:
    """Return the first error in a group of errors, looking into groups inside it.

    The others become notes of this error.
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
