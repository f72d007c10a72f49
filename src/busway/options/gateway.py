"""Options of a gateway: of the whole gateway, of its listeners, and of its upstreams."""

from dataclasses import dataclass
from typing import Annotated

from ..codes import TCP_DEVICE_UNIT
from .client import CLIENT_DEADLINE
from .declaration import Range, check


@dataclass(frozen=True, slots=True)
class UpstreamParameters:
    """Options of an upstream of a gateway, in addition to those of links."""

    connections: Annotated[
        int,
        Range(1, 16),
        "connections to one server; all requests of a client take the same one, so that its order is kept. A serial",
        "port is opened once.",
    ] = 1
    share_reads: Annotated[bool, "whether identical reads in flight are sent once."] = True
    broadcast: Annotated[
        bool | None, "whether a write to unit 0 is forwarded; None: where the framing is RTU or ASCII."
    ] = None

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class GatewayListenerParameters:
    """Options of a listener of a gateway, in addition to those of listeners."""

    client_deadline: Annotated[
        float | None,
        Range(0.001, 3600),
        "seconds within which each request is answered, with 0A or 0B at the latest; None: as late as the line is.",
        "What is still queued then is not sent any more.",
    ] = CLIENT_DEADLINE
    silent_broadcasts: Annotated[bool, "whether a write to unit 0 gets no answer, as on a serial line."] = False

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class GatewayParameters:
    """Options that apply to a whole gateway."""

    own_unit: Annotated[int | None, Range(1, 255), "unit of the gateway itself; None: it is no device."] = (
        TCP_DEVICE_UNIT
    )
    own_registers: Annotated[bool, "whether the own unit has registers with the gateway's figures."] = False
    drain: Annotated[float, Range(0, 600), "seconds for which SIGTERM waits for answers."] = 5.0

    def __post_init__(self) -> None:
        check(self)
