"""Fault profiles that no server can simulate, such as those of ports and clients, and what simulates them instead.

Knows names and texts only; they complete the documentation's table of fault profiles.
"""

from dataclasses import dataclass
from typing import Final

from ..clients import CLIENT_FAULT_PROFILES


@dataclass(frozen=True, slots=True)
class FaultNotSimulated:
    """A fault profile that no server can simulate, and what simulates it instead.

    Attributes:
        name: name of the profile, as in the documentation.
        happens: what goes wrong, in words.
        seen_in: repositories and issues where it was reported.
        answer: the right reaction of the other side, in words.
        played_by: what simulates it, and why a server cannot.
    """

    name: str
    happens: str
    seen_in: tuple[str, ...]
    answer: str
    played_by: str


HOT_UNPLUG = FaultNotSimulated(
    "hot-unplug",
    "the port vanishes, and comes back under the same or another name",
    ("mqmgateway#9",),
    "closes at once, and finds the port again by its path or its USB identity",
    "the port is the client's, not the device's: `PacedLine.unplug` and `PacedLine.replug`",
)
BAD_CERTIFICATE = FaultNotSimulated(
    "bad-certificate",
    "a certificate that is expired, of a foreign authority, without a role, with two or with a malformed one",
    ("pysunspec2#117", "tmodbus#102"),
    "refuses with the exact reason, and leaves no socket open",
    "it is shown before any request: a `tls://` listener or client with a certificate of `CertificateStore`",
)

NOT_SIMULATED: Final = {
    one.name: one
    for one in (
        HOT_UNPLUG,
        BAD_CERTIFICATE,
        *(
            FaultNotSimulated(
                one.name, one.happens, one.seen_in, one.answer, "it is one of clients: `misbehaving_client`"
            )
            for one in CLIENT_FAULT_PROFILES.values()
        ),
    )
}
"""All fault profiles that no server can simulate, by name."""
