"""The interface through which collectors of a fleet share the keys of commands, so that each command is sent once.

A collector takes the key of a command for all collectors before it sends the command. Knows commands and results; knows
no fleet. A collector that works alone needs no such object: its journal is enough.
"""

from typing import Protocol

from ....errors import ModbusError
from .command import CommandResult


class KeysUnavailable(ModbusError):
    """Error: it is unknown whether a command's key was used before, and cannot be found out now. Nothing was sent."""


class KeyClaims(Protocol):
    """Interface of the keys of commands that the collectors of a fleet share, so that each key is sent at most once."""

    async def claim(self, result: CommandResult) -> CommandResult | None:
        """Take the key of a command, durably and for all collectors. Call `finish` when the command has ended.

        Args:
            result: open for a command that will be sent, or finished for one that will not.

        Returns:
            None if the key was new and is taken now. Else the result of the first command with this key: ``unknown`` if
                it is not finished, a refusal if its result is no longer kept.

        Raises:
            KeysUnavailable: it is not known whether the key is new. The command must not be sent.
            Overloaded: no further key can be remembered. The command must not be sent.
        """

    def known(self, result: CommandResult) -> CommandResult | None:
        """Return the result of the first command with the key of ``result``, if this collector knows it; else None.

        Takes no key, and waits for nothing: only `claim` tells that a key is new.
        """

    async def finish(self, result: CommandResult) -> None:
        """Record the result of a command whose key was taken.

        Raises nothing. If recording fails, other collectors see the command as ``unknown``.
        """
