"""``busway replay``: reports conversations in a capture file and what was wrong, and writes a simulation file of it.

The analysis is `busway.apps.replay`; here are the arguments, the report and the file. Packets are numbered as Wireshark
numbers them.
"""

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import typer

from ..codes import function_name
from ..errors import ConfigError
from ..values import Address, format_address
from ..values.counts import counted
from ..values.printable import printable
from .arguments import JSON, QUIET, seconds
from .captures import PORT, open_packets, say_what_was_left_out, time_text, traffic_of
from .exits import ExitCode
from .files import refuse_to_replace, write_new
from .output import print_json, say, warn

if TYPE_CHECKING:
    from ..apps.replay.conversations import CapturedConversation, CapturedConversations, Troubles
    from ..apps.replay.item_ranges import ItemRanges
    from ..apps.replay.recorded_devices import RecordedDevices
    from ..codes import Table
    from ..observe.capture_files.frame_extraction import CapturedTraffic
    from ..observe.capture_files.packet_file import PacketFile

EXAMPLES = """\b
Examples:
  busway replay site.pcapng
  busway replay site.pcapng --port 502,5020 --json
  busway replay line.pcap --reply-window 500ms --slow 100ms
  tcpdump -w - port 502 | busway replay -
  busway replay site.pcapng --simulate plant.toml --server 10.0.0.5

Captures are pcap or pcapng, of Ethernet, Linux cooked, loopback or raw IP, or of a serial line.
"""

_MOST_RANGES: Final = 12
"""Number of ranges of items that are printed for one function code and table; further ones are only counted."""


def replay(
    capture: str = typer.Argument(..., metavar="CAPTURE", help="A capture file, pcap or pcapng; - for stdin."),
    port: str | None = PORT,
    framing: str | None = typer.Option(
        None, "--framing", metavar="NAME", help="mbap, rtu or ascii on these ports. mbap."
    ),
    reply_window: str = typer.Option(
        "3s", "--reply-window", metavar="TIME", help="A reply after this time is late: 3s."
    ),
    slow: str = typer.Option("1s", "--slow", metavar="TIME", help="A reply after this time is slow: 1s."),
    simulate: str | None = typer.Option(
        None, "--simulate", metavar="FILE", help="Write a simulation file that answers as the devices did: plant.toml."
    ),
    server: str | None = typer.Option(
        None, "--server", metavar="HOST", help="With --simulate: which server, if there are several: 10.0.0.5."
    ),
    values: str | None = typer.Option(
        None, "--values", metavar="NAME", help="With --simulate: the first values of the capture, or the last. first."
    ),
    delays: bool = typer.Option(False, "--delays", help="With --simulate: reply after the typical time of each unit."),
    force: bool = typer.Option(False, "--force", help="Write over the file of --simulate."),
    as_json: bool = JSON,
    quiet: bool = QUIET,
) -> int:
    """Show what was said in a capture file, and what was wrong."""
    from ..apps.replay.conversations import CapturedConversations
    from ..apps.replay.exchanges import Exchanges
    from ..apps.replay.recorded_devices import RecordedDevices

    wanted = _Wanted(simulate, server, values, delays, force)
    wanted.check()
    devices = RecordedDevices()
    window = seconds(reply_window, "--reply-window", high=3600)
    exchanges = Exchanges(window, seconds(slow, "--slow", high=3600))
    traffic = traffic_of(port, framing)
    conversations = CapturedConversations()
    with open_packets(capture) as file:
        try:
            for event in _events(file, traffic):
                for exchange in exchanges.take(event):
                    conversations.add(exchange)
                    if simulate is not None:
                        devices.add(exchange)
        finally:  # of a file that is broken, what stands before that
            if file.packets:
                _report(conversations, file, traffic, as_json=as_json)
                say_what_was_left_out(file, traffic, len(conversations))
    wanted.write(devices)
    return ExitCode.DONE


@dataclass(frozen=True, slots=True)
class _Wanted:
    """The options of ``busway replay`` that concern the simulation file, as on the command line.

    ``path`` is that of ``--simulate``, None without; ``force``: whether an existing file is overwritten.
    """

    path: str | None
    server: str | None
    values: str | None
    delays: bool
    force: bool

    def check(self) -> None:
        """Check the options. Raises `ConfigError` if one is invalid or has no effect.

        It is raised if ``--values`` is neither ``first`` nor ``last``; if the file of ``--simulate`` exists and
        ``--force`` is missing; and without ``--simulate`` if any of the other options is given.
        """
        if self.values not in (None, "first", "last"):
            raise ConfigError(f"first or last is needed, not {self.values!r}", key="--values")
        if self.path is not None:
            refuse_to_replace(self.path, force=self.force)
            return
        given = {"--server": self.server, "--values": self.values, "--delays": self.delays, "--force": self.force}
        for option, value in given.items():
            if value:
                raise ConfigError("goes with --simulate only", key=option)

    def write(self, devices: "RecordedDevices") -> None:
        """Write the simulation file if ``--simulate`` is given, and print warnings about what it cannot reproduce.

        Raises:
            ConfigError: ``--server`` fits no server or several, nothing was answered, or the file cannot be written.
        """
        if self.path is None:
            return
        file = devices.file(self.server, last=self.values == "last", delays=self.delays)
        for remark in file.remarks:
            warn(remark)
        write_new(self.path, file.text, force=self.force, kind="recording")
        units = ", ".join(map(str, file.units))
        say(f"{self.path} is written: {counted(len(file.units), 'unit')} of {printable(file.server)}: {units}")


def _events(file: "PacketFile", traffic: "CapturedTraffic") -> Iterator[Any]:  # TrafficEvent
    try:
        for packet in file:
            yield from traffic.take(packet)
    except ConfigError:
        yield from traffic.finish()
        raise
    yield from traffic.finish()


# The report.


def _report(
    conversations: "CapturedConversations", file: "PacketFile", traffic: "CapturedTraffic", *, as_json: bool
) -> None:
    for number, conversation in enumerate(conversations):
        if as_json:
            print_json(_json(conversation))
            continue
        if number:
            print()
        for line in _lines(conversation):
            print(line)
    if as_json:
        print_json(_summary_json(conversations, file, traffic))
        return
    sys.stdout.flush()
    say("; ".join(_summary(conversations, file, traffic)))


def _summary(conversations: "CapturedConversations", file: "PacketFile", traffic: "CapturedTraffic") -> Iterator[str]:
    yield f"{counted(len(conversations), 'conversation')} in {counted(file.packets, 'packet')}"
    if traffic.begun_inside:
        yield f"of {counted(traffic.begun_inside, 'connection')} the capture does not have the beginning"
    if traffic.repeated or traffic.out_of_order:
        again, late = counted(traffic.repeated, "byte"), counted(traffic.out_of_order, "segment")
        yield f"TCP sent {again} again and {late} out of order"
    if conversations.left_out:
        yield f"{conversations.left_out} exchanges of further conversations are not shown"


def _summary_json(
    conversations: "CapturedConversations", file: "PacketFile", traffic: "CapturedTraffic"
) -> dict[str, Any]:  # what JSON has
    return {
        "kind": "summary",
        "packets": file.packets,
        "truncated_at": file.truncated_at,
        "conversations": len(conversations),
        "left_out": conversations.left_out,
        "begun_before_the_capture": traffic.begun_inside,
        "tcp_bytes_repeated": traffic.repeated,
        "tcp_segments_out_of_order": traffic.out_of_order,
        "ignored": dict(traffic.ignored),
    }


def _name(conversation: "CapturedConversation") -> str:
    ends = printable(conversation.server)
    if conversation.client:
        ends = f"{conversation.client} → {ends}"
    return f"{ends}, {'no unit' if conversation.unit is None else f'unit {conversation.unit}'}"


def _lines(conversation: "CapturedConversation") -> Iterator[str]:
    yield _name(conversation)
    span = conversation.last - conversation.first
    yield f"  {time_text(conversation.first)} UTC, {_time(span)}"
    if conversation.requests:
        yield f"  {', '.join(_counts(conversation))}"
    for code, count in sorted(conversation.requests.items()):
        ranges = ", ".join(_ranges(conversation.items.get(code, {})))
        yield f"    {count:6} × {function_name(code)}{f': {ranges}' if ranges else ''}"
    times = conversation.times
    if times.count:
        yield (
            f"  replies after {_time(times.fastest)} to {_time(times.slowest)} (packet {conversation.slowest_packet}),"
            f" {_time(times.mean)} on average"
        )
    for kind, troubles in conversation.troubles.items():
        yield f"  ! {troubles.count} × {kind.value}: {_cases(troubles)}"


def _counts(conversation: "CapturedConversation") -> Iterator[str]:
    yield counted(sum(conversation.requests.values()), "request")
    yield f"{conversation.replies} {'reply' if conversation.replies == 1 else 'replies'}"
    if conversation.exceptions:
        yield counted(sum(conversation.exceptions.values()), "exception")
    if conversation.broadcasts:
        yield counted(conversation.broadcasts, "broadcast")
    if conversation.waiting:
        yield f"{conversation.waiting} without a reply yet when the capture ended"


def _cases(troubles: "Troubles") -> str:
    shown = troubles.worst or troubles.first
    which = "" if troubles.count == 1 else "the worst in " if troubles.worst else "first in "
    return f"{which}packet {shown.packet}{f': {shown.text}' if shown.text else ''}"


def _ranges(tables: "dict[Table, ItemRanges]") -> Iterator[str]:
    for table, ranges in tables.items():
        for number, (first, end) in enumerate(ranges):
            if number == _MOST_RANGES:
                yield f"and {len(ranges) - number} more ranges"
                break
            yield _range(table, first, end)


def _range(table: "Table", first: int, end: int) -> str:
    text = format_address(Address(table, first))
    return text if end == first + 1 else f"{text}-{format_address(Address(table, end - 1))}"


def _time(span: float) -> str:
    """Return a time span in seconds as text: in ms if it is shorter than a second, else in s."""
    return f"{span * 1e3:.1f} ms" if span < 1 else f"{span:.1f} s"


def _json(conversation: "CapturedConversation") -> dict[str, Any]:  # what JSON has
    return {
        "kind": "conversation",
        "client": conversation.client or None,
        "server": conversation.server,
        "unit": conversation.unit,
        "first": conversation.first,
        "last": conversation.last,
        "requests": {str(code): count for code, count in sorted(conversation.requests.items())},
        "replies": conversation.replies,
        "exceptions": [
            {"function": code, "exception": exception, "count": count}
            for (code, exception), count in sorted(conversation.exceptions.items())
        ],
        "broadcasts": conversation.broadcasts,
        "waiting": conversation.waiting,
        "items": {str(code): _ranges_json(tables.items()) for code, tables in sorted(conversation.items.items())},
        "fastest": round(conversation.times.fastest, 6) if conversation.times.count else None,
        "slowest": round(conversation.times.slowest, 6) if conversation.times.count else None,
        "slowest_packet": conversation.slowest_packet or None,
        "mean": round(conversation.times.mean, 6) if conversation.times.count else None,
        "troubles": [
            {
                "trouble": kind.value,
                "count": troubles.count,
                "packet": (troubles.worst or troubles.first).packet,
                "text": (troubles.worst or troubles.first).text,
            }
            for kind, troubles in conversation.troubles.items()
        ],
    }


def _ranges_json(tables: "Iterable[tuple[Table, ItemRanges]]") -> list[dict[str, Any]]:  # what JSON has
    return [
        {"table": table.value, "first": first, "count": end - first}
        for table, ranges in tables
        for first, end in ranges
    ]
