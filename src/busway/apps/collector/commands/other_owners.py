"""The interface through which a collector of a fleet deals with commands for links that another collector owns.

Knows commands; knows no fleet. A collector that works alone has none: all links of its file are its own.
"""

from typing import Any, Protocol

from .command import PointCommand


class OtherOwners(Protocol):
    """Interface of a fleet as the messages with commands see it: who owns a device's link, and who answers."""

    member: str
    """The name of this collector."""
    group: str
    """The name under which the collectors share messages, so that each goes to one of them; empty where messages go to
    all, because no command can be passed on."""

    def owned_since(self, device: str) -> float | None:
        """Return since when this collector polls a device, so that it executes commands for it; None if it does not.

        Seconds of the monotonic clock.
        """

    async def answers(self, device: str | None) -> bool:
        """Return whether this collector answers for a device where messages go to all: its owner, or one of them if it
        has none, or if the device is None for a message that names none. What looks like none is looked at twice.
        """

    async def pass_on(self, command: PointCommand) -> dict[str, Any]:
        """Have the owner of a link execute a command, and return its answer; errors are told in the answer."""
