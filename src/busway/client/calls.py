"""What both interfaces share between a call and a demand: defaults of a link, options of a call, units.

Knows defaults and checks; knows no link and does no IO.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..codes import TCP_DEVICE_UNIT
from ..config.endpoints import Endpoint, parse_endpoint
from ..config.options import build_parameters, option_names
from ..errors import ConfigError, InvalidRequest
from ..pdu.compiler import as_integer
from ..pdu.message import Request
from ..session.demand import Demand
from ..session.parameters import ClientParameters
from ..transport.tcp import SocketParameters
from .operations import CallOptions

CALL_DEFAULTS = ("timeout", "retries", "deadline")
"""What each user of a shared link may choose for himself; the rest belongs to the connection."""


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Everything that `busway.open` and `busway.connect` were told.

    Attributes:
        endpoint: where the link leads.
        parameters: of the conversation.
        sockets: of the connection.
    """

    endpoint: Endpoint
    parameters: ClientParameters
    sockets: SocketParameters

    def differs(self, other: "LinkSettings") -> str:
        """The first setting of the connection that differs, or an empty string."""
        for mine, theirs in ((self.parameters, other.parameters), (self.sockets, other.sockets)):
            for name in option_names(type(mine)):
                if name not in CALL_DEFAULTS and getattr(mine, name) != getattr(theirs, name):
                    return name
        return ""


def link_settings(url: str | Endpoint, options: Mapping[str, object]) -> LinkSettings:
    """Settings from a URL with its options, and from keywords, which go before them. Raises `ConfigError`."""
    endpoint = parse_endpoint(url)
    chosen: tuple[dict[str, object], dict[str, object]] = ({}, {})
    kinds = (ClientParameters, SocketParameters)
    for name, value in {**endpoint.options, **options}.items():
        for kind, values in zip(kinds, chosen, strict=True):
            if name in option_names(kind):
                values[name] = value
                break
        else:
            known = sorted(name for kind in kinds for name in option_names(kind))
            raise ConfigError(f"unknown option of {endpoint.url}; there are {', '.join(known)}", key=name)
    return LinkSettings(
        endpoint, build_parameters(ClientParameters, chosen[0]), build_parameters(SocketParameters, chosen[1])
    )


def default_unit(endpoint: Endpoint, unit: int | None) -> int:
    """The unit to ask: 255 where none is named on TCP (Messaging on TCP/IP V1.0b §4.4.1.2). Raises `InvalidRequest`."""
    if unit is None:
        if endpoint.framing != "mbap":
            raise InvalidRequest("a unit is needed on a serial line: link.unit(1)", endpoint=endpoint.url)
        return TCP_DEVICE_UNIT
    if not 0 <= as_integer("unit", unit) <= 255:
        raise InvalidRequest(f"unit must be 0…255, not {unit}", endpoint=endpoint.url)
    return unit


def demand_for(
    unit: int,
    requests: Sequence[Request],
    defaults: ClientParameters,
    call: CallOptions,
    *,
    now: float,
    caller: object = None,
) -> Demand:
    """The demand of one call; ``caller`` may be named later, when it has to queue."""
    deadline = defaults.deadline
    timeout = defaults.timeout
    retries = defaults.retries
    idempotent = False
    if call:
        timeout, retries, deadline, idempotent = _checked(call, timeout, retries, deadline)
    is_write = False
    for request in requests:
        if request.is_write:
            is_write = True
            break
    return Demand(
        unit,
        requests,
        is_write=is_write,
        timeout=timeout,
        retries=retries,
        idempotent=idempotent,
        caller=caller,
        deadline=None if deadline is None else now + deadline,
    )


def _checked(
    call: CallOptions, timeout: float, retries: int, deadline: float | None
) -> tuple[float, int, float | None, bool]:
    rest: dict[str, Any] = dict(call)
    timeout = rest.pop("timeout", None) or timeout
    retries = rest.pop("retries", retries)
    deadline = rest.pop("deadline", None) or deadline
    idempotent = rest.pop("idempotent", False)
    if rest:
        raise InvalidRequest(
            f"unknown option {next(iter(rest))}; a call takes timeout, retries, deadline and idempotent"
        )
    if not 0 < timeout <= 3600:
        raise InvalidRequest(f"timeout must be above 0 and at most 3600 seconds, not {timeout}")
    if not 0 <= retries <= 100:
        raise InvalidRequest(f"retries must be 0…100, not {retries}")
    if deadline is not None and deadline <= 0:
        raise InvalidRequest(f"deadline must be above 0 seconds, not {deadline}")
    return timeout, retries, deadline, idempotent


def closed_error(settings: LinkSettings) -> InvalidRequest:
    """The error of a call on a link that its user has closed."""
    return InvalidRequest("this link was closed by its user; nothing was sent", endpoint=settings.endpoint.url)


def check_same(held: LinkSettings, wanted: LinkSettings) -> None:
    """Raise `ConfigError` where two users of an endpoint want different connections."""
    different = held.differs(wanted)
    if different:
        raise ConfigError(
            f"{held.endpoint.url} is open already with another {different}; shared=False gives a connection of its own",
            key=different,
        )
