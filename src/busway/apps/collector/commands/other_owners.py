"""The interface through which a collector of a fleet deals with commands for links that another collector owns.

Knows commands; knows no fleet. A collector that works alone needs no such object: all links of its file are its own.
"""

from typing import Any, Protocol

from .command import PointCommand


class OtherOwners(Protocol):
    """Interface of a fleet as the receiver of commands sees it: who owns the link of a device, and who answers."""

    member: str
    """The name of this collector."""
    group: str
    """The name under which the collectors share messages, so that each message goes to one of them. Empty if every
    collector gets every message, because commands cannot be passed on."""

    def owned_since(self, device: str) -> float | None:
        """Return since when this collector owns the link of a device; None if it does not own it now.

        The time is in seconds of the monotonic clock. A collector polls the links that it owns, and executes the
        commands for their devices.
        """

    async def answers(self, device: str | None) -> bool:
        """Return whether this collector answers a message for a device, where each message goes to all collectors.

        The owner of the device's link answers. For a link without an owner, and for a message without a device, one
        collector answers, which all choose alike. If a link seems to have no owner, ownership is looked up again after
        a pause.

        Args:
            device: name of the device; None for a message that names none.
        """

    async def pass_on(self, command: PointCommand, role: str) -> dict[str, Any]:
        """Have the owner of the device's link execute a command, and return its answer, as JSON data.

        Raises nothing: an error is part of the answer, as a refusal with its reason.

        Args:
            command: the command.
            role: the role of its writer. The owner decides what the role permits by its own configuration, which may be
                newer than that of this collector.
        """
