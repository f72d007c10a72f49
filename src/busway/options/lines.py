"""Options of serial lines: the master's timing, the framing, and circuit breakers of units."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from ..errors import ConfigError
from .declaration import ByFraming, On, Range, Strict, check


@dataclass(frozen=True, slots=True)
class SerialClientParameters:
    """Options of the master of a serial line, in addition to `ClientParameters`."""

    on: ClassVar[On] = On("client rtu", "client ascii")

    turnaround_delay: Annotated[
        float,
        Range(0, 10, "seconds"),
        "seconds after a broadcast before the next request (§2.4.1: 100…200 ms typical).",
    ] = 0.1
    unit_switch_gap: Annotated[
        float,
        Range(0, 10, "seconds"),
        "seconds of silence before a request to another unit than the last, at least t3.5.",
    ] = 0.0
    quiet_window: Annotated[float, Range(0, 10, "seconds"), "seconds of silence that end a drain after a timeout."] = (
        0.05
    )
    drain_limit: Annotated[
        float, Range(0, 60, "seconds"), "seconds after which a drain ends although the line never fell silent."
    ] = 1.0
    trust_reply_order: Annotated[
        bool,
        "whether units are known to answer requests in their order. Then a unit that did not answer gets the next",
        "request as soon as it has answered a marker; otherwise not before twice the timeout has passed since the",
        "request that it did not answer.",
    ] = False
    early_replies: Annotated[
        bool, "whether to accept replies that begin before t3.5 has passed since the request (§2.5.1.1)."
    ] = False

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class BreakerParameters:
    """Options of the circuit breakers: when a unit is suspended, and when it is probed."""

    on: ClassVar[On] = On("client")

    # A device on TCP delays no other. In a gateway the units of an upstream server share its connection, so the default
    # is that of a serial line.
    open_after: Annotated[
        int,
        Range(0, 1000),
        ByFraming({"mbap": 0, "rtu": 3, "ascii": 3}),
        "timeouts in a row that open the breaker; 0 switches it off. The default depends on the framing of the",
        "endpoint; it is 3 for the upstream links of a gateway.",
    ] = 3
    first_pause: Annotated[float, Range(0.01, 3600), "seconds until the first probe."] = 3.0
    longest_pause: Annotated[float, Range(0.01, 3600), "seconds at most between probes."] = 8.5
    probe_timeout: Annotated[
        float,
        Range(0.001, 3600),
        "minimum seconds that a probe waits for its reply, unless the request's own timeout is shorter; a unit that",
        "never answered and is slower than all others needs a longer one.",
    ] = 0.1

    def __post_init__(self) -> None:
        check(self)
        if self.longest_pause < self.first_pause:
            raise ConfigError(f"must be at least first_pause, {self.first_pause:g}", key="longest_pause")


@dataclass(frozen=True, slots=True)
class FramingParameters:
    """Options of the framing of a serial line."""

    on: ClassVar[On] = On("rtu", "ascii")

    strict_timing: Annotated[
        bool,
        On("rtu serial"),
        Strict("S10", True),
        "RTU to the letter (Serial Line V1.02 §2.5.1.1): a gap above t1.5 spoils a frame, silence ends it. Only for",
        "ports that deliver each character at once.",
    ] = False
    gap_limit: Annotated[
        float | None,
        Range(0, 10, words="above 0 and at most 10 seconds", above=True),
        On("rtu"),
        "RTU: seconds that an unfinished frame waits for its rest, at least t3.5; None for 50 ms or t3.5, whichever is",
        "longer, except that an expected reply that has begun may take until its timeout.",
    ] = None
    character_timeout: Annotated[
        float,
        Range(0, 60, words="above 0 and at most 60 seconds", above=True),
        On("ascii"),
        Strict("S12", 1.0, adaptable=True),
        "ASCII: seconds that may pass between two characters.",
    ] = 1.0
    delimiter: Annotated[
        int,
        Range(0, 0x7F, words="an ASCII character, 0…127"),
        On("ascii"),
        "ASCII: the character that ends a frame behind CR (function 08/03); 10 is LF.",
    ] = 0x0A
    upper_case_only: Annotated[
        bool,
        On("ascii"),
        Strict("S12", True),
        "ASCII: whether frames with hexadecimal digits in lower case are refused.",
    ] = False

    def __post_init__(self) -> None:
        check(self)
        if self.gap_limit is not None and self.strict_timing:
            raise ConfigError("does not go with strict_timing, which allows t1.5", key="gap_limit")
