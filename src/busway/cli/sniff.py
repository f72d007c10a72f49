"""``busway sniff``: shows the traffic of a serial line. It listens and never sends.

1. One line per frame: time, silence before it in ms, unit, function, fields. Damaged bytes are shown with the reason,
   and a request without a reply has a line of its own.
2. Statistics are printed at the end: after Ctrl-C, SIGTERM or ``--for``, and also if the connection was lost.
3. If a serial port vanishes, it is opened again when it is back; if it is still gone at the end, the exit code is 5.
"""

import sys
import time
from contextlib import ExitStack, nullcontext
from datetime import datetime
from typing import TYPE_CHECKING, Any

import typer

from ..values.counts import counted
from .arguments import CAPTURE, JSON, QUIET, seconds
from .exits import ExitCode
from .files import open_capture
from .output import print_aligned, print_json, say, warn
from .signals import stop_flag

if TYPE_CHECKING:
    from threading import Event

    from ..observe.capture import LineCapture
    from ..observe.pairing import Heard, LineStatistics
    from ..observe.sniffing import Listening
    from ..pdu.describe import Description

EXAMPLES = """\b
Examples:
  busway sniff rtu:///dev/ttyUSB0
  busway sniff 'rtu:///dev/ttyUSB0?baud=9600&parity=none' --for 1m
  busway sniff ascii:///dev/ttyS1 --json
  busway sniff rtu+tcp://10.0.0.9:4001 --capture line.pcapng
  busway sniff rtu+udp://:4001

Over TCP a device server is dialled. Over UDP it has to send its datagrams here; the URL names the port they come to.
The times in front: when a frame began, and the silence before it in milliseconds.
"""

_HEADING = "unit, requests, replies, exceptions, no reply, repeats, stray, fastest ms, mean, slowest"


def sniff(
    url: str = typer.Argument(
        ...,
        metavar="URL",
        help="The line: rtu:///dev/ttyUSB0, ascii:///dev/ttyS1, rtu+tcp://host:4001, rtu+udp://:4001.",
    ),
    duration: str | None = typer.Option(None, "--for", metavar="TIME", help="End after this time: 30s, 5m, 1h."),
    reply_window: str = typer.Option(
        "1s",
        "--reply-window",
        metavar="TIME",
        help="A request without a reply within this time counts as unanswered: 1s.",
    ),
    raw: bool = typer.Option(False, "-x", "--hex", help="Show the bytes of each frame too."),
    capture: str | None = CAPTURE,
    as_json: bool = JSON,
    quiet: bool = QUIET,
) -> int:
    """Listen to a line, never send."""
    from ..observe.pairing import Pairing
    from ..observe.sniffing import Listening, sniffed_line

    line = sniffed_line(url)
    window = seconds(reply_window, "--reply-window", low=0.001, high=60)
    lasting = None if duration is None else seconds(duration, "--for", low=0.01, high=10 * 365 * 86_400)
    with ExitStack() as stack:
        file = stack.enter_context(open_capture(capture) if capture is not None else nullcontext())
        listening = stack.enter_context(
            Listening(
                line,
                Pairing(window),
                vanished=lambda error: warn(f"{line.endpoint.url}: {error.message}; waiting for it"),
                returned=lambda: say(f"{line.endpoint.url}: it is back"),
            )
        )
        sniffing = _Sniffing(
            listening,
            file.line(line.endpoint.url) if file is not None else None,
            is_wire=line.port is not None,
            as_json=as_json,
            raw=raw,
        )
        stop = stack.enter_context(stop_flag())
        say(f"listening to {line.endpoint.url}{f', {line.port}' if line.port is not None else ''}")
        return sniffing.run(lasting, stop)


class _Sniffing:
    """One run of ``busway sniff``: listens to a line, prints frames and statistics, and writes the capture file."""

    def __init__(
        self,
        listening: "Listening",
        capture: "LineCapture | None",
        *,
        is_wire: bool,
        as_json: bool,
        raw: bool,
    ) -> None:
        self._listening = listening
        self._capture = capture
        self._is_wire = is_wire
        self._as_json = as_json
        self._raw = raw
        self._began = time.monotonic()
        self._wall = time.time() - self._began  # added to the clock of the frames it gives the time of day

    def run(self, lasting: float | None, stop: "Event") -> int:
        """Listen to the line and print its frames until the time is over or a signal comes; then print the statistics.

        Args:
            lasting: seconds; None for no limit.
            stop: set by a signal.

        Returns:
            The exit code; `ExitCode.NO_CONNECTION` if the serial port has vanished and is still gone at the end.

        Raises:
            LinkDown: the network connection to the line was lost; the statistics are printed.
        """
        until = float("inf") if lasting is None else self._began + lasting
        try:
            while time.monotonic() < until and not stop.is_set():
                self._show(self._listening.hear(until))
            self._show(self._listening.finish())
        finally:
            self._conclude(time.monotonic() - self._began)
        return ExitCode.DONE if self._listening.lost is None else ExitCode.NO_CONNECTION

    def _show(self, events: "list[Heard]") -> None:
        for event in events:
            if self._capture is not None:
                self._keep(event)
            when = datetime.fromtimestamp(self._wall + event.at).astimezone()
            if self._as_json:
                print_json(_as_json(event, when.isoformat(timespec="microseconds")))
            else:
                self._print(event, f"{when:%H:%M:%S.%f}"[:-3])
        if events:
            sys.stdout.flush()

    def _keep(self, event: "Heard") -> None:
        from ..framing.received import Direction
        from ..observe.pairing import Kind

        assert self._capture is not None
        found = event.frame if event.kind is not Kind.DAMAGED else event.damaged
        if event.kind is Kind.UNANSWERED or found is None:
            return
        direction = Direction.REPLY if event.kind in (Kind.REPLY, Kind.STRAY) else Direction.REQUEST
        self._capture.heard(found, at=self._wall + found.began, direction=direction)

    def _print(self, event: "Heard", when: str) -> None:
        from ..observe.pairing import Kind

        gap = "" if event.gap is None else f"{event.gap * 1000:.1f}"
        print(f"{when}  {gap:>9}  {_sentence(event)}")
        found = event.frame if event.frame is not None else event.damaged
        if self._raw and event.kind is not Kind.UNANSWERED and found is not None:
            print(f"{'':{len(when)}}  {'':>9}  {_bytes(found.raw)}")

    def _conclude(self, lasted: float) -> None:
        statistics = self._listening.pairing.statistics
        if self._as_json:
            print_json(_statistics_json(statistics, lasted))
        else:
            _print_statistics(statistics, lasted, is_wire=self._is_wire)
        sys.stdout.flush()


def _describe(event: "Heard") -> "Description":
    """Return the description of the frame of an event in words; that of a reply also uses its request, if known.

    The event must have a frame.
    """
    from ..framing.received import Direction
    from ..observe.pairing import Kind
    from ..observe.wording import described

    assert event.frame is not None
    if event.kind not in (Kind.REPLY, Kind.STRAY):
        return described(event.frame.pdu, Direction.REQUEST)
    asked = None if event.request is None else described(event.request.pdu, Direction.REQUEST).message
    return described(event.frame.pdu, Direction.REPLY, request=asked)


def _sentence(event: "Heard") -> str:
    from ..observe.pairing import Kind
    from ..observe.wording import in_words

    if event.frame is None:
        assert event.damaged is not None
        return f"! {event.damaged.size} damaged bytes, {event.damaged.reason.value}: {_bytes(event.damaged.raw)}"
    who = "all units" if event.kind is Kind.BROADCAST else f"unit {event.frame.unit}"
    description = _describe(event)
    if event.kind is Kind.UNANSWERED:
        assert event.response_time is not None
        but = f", but {event.damaged.size} damaged bytes" if event.damaged is not None else ""
        return f"! {who}: {description.title} was not answered within {event.response_time * 1000:.0f} ms{but}"
    words = f"{who}: {in_words(description)}"
    if event.response_time is not None:
        words += f" (after {event.response_time * 1000:.1f} ms)"
    if event.kind is Kind.STRAY:
        words += " ! unsolicited reply"
    if event.is_repeat:
        words += " (asked again)"
    return words + (" (found among damaged bytes)" if event.frame.recovered else "")


def _bytes(data: bytes) -> str:
    if data.startswith(b":"):
        return data.decode("ascii", errors="backslashreplace").rstrip("\r\n")
    return data.hex(" ")


def _as_json(event: "Heard", when: str) -> dict[str, Any]:  # Any: JSON
    said: dict[str, Any] = {"time": when, "kind": event.kind.value, "gap": _rounded(event.gap)}
    if event.frame is not None:
        description = _describe(event)
        said |= {
            "unit": event.frame.unit,
            "function": event.frame.pdu[0] & 0x7F,
            "title": description.title,
            "fields": [
                {"name": part.name, "bytes": part.data.hex(), "value": part.text, "problem": part.problem}
                for part in description.parts[1:]
            ],
            "problems": list(description.problems),
            "response_time": _rounded(event.response_time),
            "is_repeat": event.is_repeat,
            "recovered": event.frame.recovered,
            "raw": event.frame.raw.hex(),
        }
    if event.damaged is not None:
        said["damaged"] = {
            "size": event.damaged.size,
            "reason": event.damaged.reason.value,
            "raw": event.damaged.raw.hex(),
        }
    return said


def _statistics_json(statistics: "LineStatistics", lasted: float) -> dict[str, Any]:  # Any: JSON
    return {
        "kind": "statistics",
        "seconds": _rounded(lasted),
        "busy": _rounded(statistics.busy),
        "frames": statistics.frames,
        "frame_bytes": statistics.frame_bytes,
        "broadcasts": statistics.broadcasts,
        "damaged": {reason.value: count for reason, count in statistics.damaged.items()},
        "damaged_bytes": statistics.damaged_bytes,
        "units": {
            str(number): {
                "requests": unit.requests,
                "replies": unit.replies,
                "exceptions": unit.exceptions,
                "unanswered": unit.unanswered,
                "repeats": unit.repeats,
                "damaged_replies": unit.damaged_replies,
                "stray_replies": unit.stray_replies,
                "response_time": {
                    "fastest": _rounded(unit.response_times.fastest),
                    "mean": _rounded(unit.response_times.mean),
                    "slowest": _rounded(unit.response_times.slowest),
                }
                if unit.replies
                else None,
            }
            for number, unit in sorted(statistics.units.items())
        },
    }


def _rounded(time: float | None) -> float | None:
    return None if time is None else round(time, 6)


def _print_statistics(statistics: "LineStatistics", lasted: float, *, is_wire: bool) -> None:
    damaged = sum(statistics.damaged.values())
    busy = f", the line was busy {min(100 * statistics.busy / lasted, 100):.1f} %" if is_wire and lasted else ""
    print(f"\n{counted(statistics.frames, 'frame')} in {lasted:.1f} s{busy}")
    if statistics.broadcasts:
        print(f"{statistics.broadcasts} of them for all units")
    if damaged:
        reasons = ", ".join(f"{reason.value}: {count}" for reason, count in statistics.damaged.most_common())
        size = counted(statistics.damaged_bytes, "byte")
        print(f"{counted(damaged, 'disturbance')}, {size} in all ({reasons})")
    if not statistics.units:
        return
    heading = _HEADING.split(", ")
    rows = [heading]
    for number, unit in sorted(statistics.units.items()):
        times = unit.response_times
        counts = (unit.requests, unit.replies, unit.exceptions, unit.unanswered, unit.repeats, unit.stray_replies)
        shown = (times.fastest, times.mean, times.slowest) if unit.replies else ()
        cells = [str(each) for each in (number, *counts)] + [f"{each * 1000:.1f}" for each in shown]
        rows.append(cells + [""] * (len(heading) - len(cells)))
    print_aligned([[cell.rjust(len(name)) for cell, name in zip(row, heading, strict=True)] for row in rows])
