"""The interface through which a collector of a fleet deals with commands for links that another collector owns.

Knows commands; knows no fleet. A collector that works alone has none: all links of its file are its own.
"""

from typing import Any, Protocol

from .command import PointCommand


class OtherOwners(Protocol):
    """Interface of a fleet as the receiver of commands sees it: who owns the link of a device, and who answers."""

    member: str
    """The name of this collector."""
    group: str
    """The name under which the collectors share messages, so that each goes to one of them; empty where messages go to
    all, because no command can be passed on."""

    def owned_since(self, device: str) -> float | None:
        """Return since when this collector polls the link of a device, in seconds of the monotonic clock; else None.

        It executes the commands for devices of links that it polls.
        """

    async def answers(self, device: str | None) -> bool:
        """Return whether this collector answers a message for a device, where each message goes to all collectors.

        The owner of the device's link answers; for a link without an owner, or a message without a device, one of the
        others. If a link seems to have no owner, ownership is looked up again after a pause.

        Args:
            device: name of the device; None for a message that names none.
        """

    async def pass_on(self, command: PointCommand, role: str) -> dict[str, Any]:
        """Have the owner of the device's link execute a command, and return its answer, as JSON data.

        Nothing is raised: an error is told in the answer.

        Args:
            command: the command.
            role: the role of its writer. The owner decides by its own configuration, which may be a newer one.
        """
