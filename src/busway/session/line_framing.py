"""Framing of a serial session: the receiver, the encoder, and the silence that a frame needs before it.

Knows which receiver goes with which framing and its options; knows no port and no session.

1. On a wire, RTU sends after t3.5 of silence. ASCII needs none, its frames have start and end characters; over
   a network the converter at the wire keeps the silence.
2. Function 08/03 may change the end delimiter of ASCII at any time; frames are sent with the delimiter of the receiver.
"""

from collections.abc import Callable, Container
from functools import partial

from ..errors import ConfigError
from ..framing.ascii import AsciiReceiver, encode_ascii
from ..framing.character_times import SerialTiming
from ..framing.echo import Echo
from ..framing.frame_direction import LineRole
from ..framing.received import SerialReceiver
from ..framing.rtu import RtuReceiver, encode_rtu
from ..framing.rtu_strict import StrictRtuReceiver
from ..options.lines import FramingParameters
from ..pdu.functions import STANDARD, FunctionTable


class LineFraming:
    """How one station (master or server) speaks RTU or ASCII: receiver, encoder, silent times.

    Created by the function `line_framing`.

    Attributes:
        receiver: finds the frames in received bytes.
        timing: character time, t1.5 and t3.5 of the line.
        send_gap: seconds of silence on the line before a frame may be sent; 0 with ASCII and over a network.
    """

    __slots__ = ("_ascii", "_make", "_rtu", "receiver", "send_gap", "timing")

    def __init__(self, make: Callable[[], SerialReceiver], timing: SerialTiming) -> None:
        self._make = make
        self.receiver: SerialReceiver = make()
        self.timing: SerialTiming = timing
        self._ascii = self.receiver if isinstance(self.receiver, AsciiReceiver) else None
        self._rtu = self.receiver if isinstance(self.receiver, RtuReceiver) else None
        self.send_gap: float = 0.0 if self._ascii is not None or not timing.character else timing.t3_5

    def begin_again(self) -> None:
        """Replace the receiver by a new one, which has received nothing.

        An ASCII delimiter set by function 08/03 stays.
        """
        delimiter = None if self._ascii is None else self._ascii.delimiter
        self.receiver = self._make()
        self._rtu = self.receiver if isinstance(self.receiver, RtuReceiver) else None
        self._ascii = self.receiver if isinstance(self.receiver, AsciiReceiver) else None
        if delimiter is not None:
            self.delimit_by(delimiter)

    @property
    def is_network(self) -> bool:
        """Whether the frames travel over a network, where characters have no duration, and not on a serial wire."""
        return not self.timing.character

    def encode(self, unit: int, pdu: bytes) -> bytes:
        """Return the frame that carries a PDU of 1…253 bytes for ``unit`` 0…255."""
        if self._ascii is not None:
            return encode_ascii(unit, pdu, self._ascii.delimiter)
        return encode_rtu(unit, pdu)

    def skip_requests(self, now: float) -> bool:
        """Record that the caller has answered requests read at ``now``, without passing their bytes to the receiver.

        Returns False, and records nothing, if the receiver needs these bytes; so always with ASCII and strict timing.
        """
        return self._rtu is not None and self._rtu.skip_requests(now)

    def delimit_by(self, character: int) -> None:
        """Set the character, 0…127, that ends ASCII frames from now on; no effect with RTU."""
        if self._ascii is not None:
            self._ascii.delimiter = character


def line_framing(
    framing: str,
    role: LineRole,
    timing: SerialTiming,
    parameters: FramingParameters | None = None,
    *,
    functions: FunctionTable = STANDARD,
    units: Container[int] = (),
    echo: Echo = Echo.OFF,
    strip_parity: bool = False,
    started: float | None = None,
) -> LineFraming:
    """Create receiver, encoder and times for one station on a serial line, or for serial framing over a network.

    Args:
        framing: ``rtu`` or ``ascii``.
        role: what the station is on the line: master, server or observer.
        timing: character times of a wire or of a network.
        parameters: options of the framing; None for the defaults.
        functions: the functions whose lengths are known.
        units: the own units of a server; a container whose content changes may be given.
        echo: whether the port echoes the bytes that are sent.
        strip_parity: only for ASCII: whether the eighth bit of a character is ignored.
        started: when the port was opened, in the clock of ``now``; None if the line is known to be idle. No effect with
            ASCII.

    Raises:
        ConfigError: a ``gap_limit`` below t3.5, or strict timing where characters have no times.
    """
    chosen = parameters or FramingParameters()
    if framing == "ascii":
        return LineFraming(
            partial(
                AsciiReceiver,
                role,
                timing,
                functions=functions,
                units=units,
                delimiter=chosen.delimiter,
                character_timeout=chosen.character_timeout,
                upper_case_only=chosen.upper_case_only,
                strip_parity=strip_parity,
                echo=echo,
            ),
            timing,
        )
    make: Callable[[], SerialReceiver]
    if chosen.strict_timing:
        if not timing.character:
            raise ConfigError("is for serial ports: a network has no times between characters", key="strict_timing")
        make = partial(StrictRtuReceiver, role, timing, functions=functions, units=units, echo=echo, started=started)
    else:
        if chosen.gap_limit is not None and chosen.gap_limit < timing.t3_5:
            raise ConfigError(f"must be t3.5 of this line ({timing.t3_5:g} s) or more", key="gap_limit")
        limit = chosen.gap_limit
        make = partial(
            RtuReceiver, role, timing, functions=functions, units=units, gap_limit=limit, echo=echo, started=started
        )
    return LineFraming(make, timing)
