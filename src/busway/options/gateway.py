"""Options of a gateway: of the whole gateway, of its listeners, and of its upstreams."""

from dataclasses import dataclass
from typing import Annotated

from ..codes import TCP_DEVICE_UNIT
from .client import CLIENT_DEADLINE
from .declaration import Name, Numbers, Range, check


@dataclass(frozen=True, slots=True)
class UpstreamParameters:
    """Options of an upstream of a gateway, in addition to those of links.

    Raises:
        ConfigError: a value is out of range.
    """

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
class RouteParameters:
    """Options of a route: which requests it applies to, whether they are forwarded, and how."""

    name: Annotated[str, "what messages call it."] = ""
    listeners: Annotated[tuple[str, ...] | None, Name("at least one name"), "names of listeners; None: of all."] = None
    units: Annotated[
        Numbers | None, 'units asked, `5`, `"1-10"`, `[1, 3, "7-9"]`; None: those that the link can have.'
    ] = None
    functions: Annotated[Numbers | None, 'function codes, or `"read"` and `"write"`; None: all.'] = None
    table: Annotated[str | None, Name("the name of a table"), "the table that plain addresses are of."] = None
    addresses: Annotated[
        Numbers | None, '`"4x1-4x100"`, or `"0-99"` with `table = "holding"`; None: all, and no items at all.'
    ] = None
    link: Annotated[str | None, Name("the name of a link"), "the link over which requests are forwarded."] = None
    refuse: Annotated[int | None, Range(1, 255), "the exception code with which requests are answered."] = None
    drop: Annotated[bool, "whether requests are not answered."] = False
    unit: Annotated[int | None, Range(0, 255), "unit behind; None: the one that was asked."] = None
    unit_offset: Annotated[int, Range(-255, 255), "added to the unit: 101…110 become 1…10 with -100."] = 0
    shift: Annotated[int, Range(-65_535, 65_535), "added to every address; the answer is shifted back."] = 0
    max_registers: Annotated[
        int | None,
        Range(1, 125),
        "registers that the device takes at once: a longer read is split, and answered whole.",
    ] = None
    max_bits: Annotated[int | None, Range(1, 2000), "the same of coils and discrete inputs."] = None
    split_writes: Annotated[bool, "whether longer writes are split too. They are no longer executed as one."] = False
    cache: Annotated[
        float | None,
        Range(0.001, 3600),
        "seconds for which a read may be answered from memory; None: it is always asked.",
    ] = None
    timeout: Annotated[float | None, Range(0.001, 3600), "seconds to wait for this unit; None: the link's."] = None
    request_gap: Annotated[
        float | None,
        Range(0.001, 60),
        "seconds that the unit is left alone after it has answered; the others are asked meanwhile. Serial lines only;",
        "elsewhere it is an option of the link.",
    ] = None

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class GatewayParameters:
    """Options that apply to a gateway as a whole."""

    own_unit: Annotated[int | None, Range(1, 255), "unit of the gateway itself; None: it is no device."] = (
        TCP_DEVICE_UNIT
    )
    own_registers: Annotated[bool, "whether the own unit has registers with the gateway's figures."] = False
    drain: Annotated[float, Range(0, 600), "seconds for which SIGTERM waits for answers."] = 5.0

    def __post_init__(self) -> None:
        check(self)
