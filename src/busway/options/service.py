"""Options of what a running server reports: its audit log, its metrics, its control socket."""

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from .declaration import Name, Range, check
from .text import host_and_port


class OnFailure(Enum):
    """Values of the option ``on_failure``: what a server does while its audit log cannot be written.

    Attributes:
        SERVE: it executes requests as usual, and counts and logs the failure.
        REFUSE: it answers writes with exception 04.
    """

    SERVE = "serve"
    REFUSE = "refuse"


@dataclass(frozen=True, slots=True)
class AuditParameters:
    """Options of the audit log, which records writes and denied requests."""

    path: Annotated[
        str,
        Name("the path of a file"),
        "file to which denied requests and writes are appended; a regular file, not reached by a link of another user.",
    ]
    interval: Annotated[
        float, Range(0, 10), "seconds after which a line stands in the file at the latest; 0: at once."
    ] = 0.2
    on_failure: Annotated[
        OnFailure,
        "what is done while the file cannot be written: `serve` goes on, counts and logs; `refuse` answers writes with",
        "exception 04.",
    ] = OnFailure.SERVE
    repeat_interval: Annotated[
        float,
        Range(0, 3600),
        "seconds after which denials that a client repeats leave one line with their number; 0: each leaves its own.",
    ] = 60.0

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class MetricsParameters:
    """Options of the HTTP endpoint with metrics for Prometheus."""

    listen: Annotated[str, "address and port, such as `127.0.0.1:9502`."]

    def __post_init__(self) -> None:
        host_and_port(self.listen, "listen")


@dataclass(frozen=True, slots=True)
class ControlParameters:
    """Options of the control socket, which ``busway status`` asks."""

    enabled: Annotated[bool, "whether there is a control socket."] = True
    path: Annotated[
        str | None,
        Name("the path of a file, or an address"),
        "where it stands, or an address of loopback; None: in the usual place.",
    ] = None

    def __post_init__(self) -> None:
        check(self)
