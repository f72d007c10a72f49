"""Keeps the ``ssl`` context of a listener or connector up to date: certificate files that have changed are read again.

Knows files and when they changed; knows no connection, and not what the files must contain (`context`).

1. The context is given to each new connection. If files that have changed are wrong, it stays as it was.
2. Files are looked at when a connection is made, at most once a second: there is no thread and no timer.
"""

import logging
import os
import ssl
import time
from collections.abc import Callable
from typing import Final

from ...errors import ConfigError
from ...options.tls import TlsParameters
from .context import authority_files

_log = logging.getLogger("busway.tls")

_LOOK_SECONDS: Final = 1.0
"""Seconds between two checks of the files of a context, however many connections are opened."""


class WatchedContext:
    """The ``ssl`` context of a listener or connector; created again when its certificate files change.

    Args:
        parameters: TLS options, which name the files.
        make: creates a context: `server_context` or `client_context`.
        name: the name of the listener or link, for the log.
        clock: returns monotonic seconds.

    Raises:
        ConfigError: the files cannot be used now.
    """

    def __init__(
        self,
        parameters: TlsParameters,
        make: Callable[[TlsParameters], ssl.SSLContext],
        *,
        name: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.parameters = parameters
        self.name = name
        self.generation: int = 0
        """How often the files were read again with success."""
        self._make = make
        self._clock = clock
        self._looked = clock()
        self._state = self._files()
        self._context = make(parameters)

    def current(self) -> ssl.SSLContext:
        """Return the ``ssl`` context for a new connection; never raises.

        At most once a second it checks whether the files have changed, and reads them again. If they cannot be used,
        that is logged once, and the earlier context is returned until the files have changed again.
        """
        now = self._clock()
        if now - self._looked >= _LOOK_SECONDS:
            self._looked = now
            state = self._files()
            if state != self._state:
                try:
                    self._renew(state)
                except ConfigError as error:
                    self._state = state  # said once; the next change is looked at again
                    _log.error("%s: the certificates stay as they were: %s", self.name, error)
        return self._context

    def reload(self) -> None:
        """Read the certificate files again now.

        Raises:
            ConfigError: a file cannot be used; the context stays as it was.
        """
        self._looked = self._clock()
        self._renew(self._files())

    def _renew(self, state: tuple[tuple[str, int, int], ...]) -> None:
        self._context = self._make(self.parameters)
        self._state = state
        self.generation += 1
        _log.info("%s: certificates read anew", self.name)

    def _files(self) -> tuple[tuple[str, int, int], ...]:
        """Return path, modification time and size of each certificate file (0 for a missing one), to notice changes."""
        chosen = self.parameters
        own = (chosen.certificate, chosen.key, chosen.password_file, chosen.revocation_list)
        names = [one for one in own if one is not None]
        if chosen.authority is not None:
            try:
                names += [chosen.authority, *authority_files(chosen.authority)]
            except ConfigError:
                names.append(chosen.authority)
        found = []
        for name in names:
            try:
                facts = os.stat(name)
            except (OSError, ValueError):
                found.append((name, 0, 0))
            else:
                found.append((name, facts.st_mtime_ns, facts.st_size))
        return tuple(found)
