"""Logs the warnings about a configuration when a program starts with it, and when it is read again.

Knows configurations that have warnings; knows no server.
"""

import logging
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from ...errors import ConfigError

_log = logging.getLogger("busway.config")


class _HasWarnings(Protocol):
    @property
    def warnings(self) -> Sequence[ConfigError]:
        """The warnings about the configuration."""


Read = TypeVar("Read", bound=_HasWarnings)


def logging_warnings(read: Callable[[], Read]) -> Callable[[], Read]:
    """Return a function that reads a configuration as ``read`` does, and logs its warnings, one line each.

    Warnings that the configuration had when it was read the last time are not logged again.
    """
    logged: frozenset[str] = frozenset()

    def read_and_log() -> Read:
        nonlocal logged
        configuration = read()
        warnings = list(map(str, configuration.warnings))
        for warning in warnings:
            if warning not in logged:
                _log.warning("%s", warning)
        logged = frozenset(warnings)
        return configuration

    return read_and_log
