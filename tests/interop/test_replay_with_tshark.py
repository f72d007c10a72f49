"""Captures that dumpcap, editcap, mergecap and text2pcap make, read as tshark reads them, and replayed."""

import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import foreign
import pytest
from captured import pieces

import busway
from busway.apps.replay.exchanges import CapturedExchange, Exchanges
from busway.apps.replay.recorded_devices import RecordedDevices
from busway.errors import ConfigError
from busway.framing.received import Direction
from busway.framing.rtu import encode_rtu
from busway.observe.capture_files.frame_extraction import CapturedFrame, CapturedTraffic, TrafficEvent
from busway.observe.capture_files.packet_file import PacketFile
from busway.testing import simulated_device

MORE_FRAMES = 60.0
"""Seconds for frames on their way into the file of dumpcap."""


def program(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        foreign.missing(f"no {name} (Debian: tshark)")
    return found


def output_of(*command: str | Path) -> str:
    finished = subprocess.run(
        [str(word) for word in command],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=foreign.LIMIT,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


def events_in(path: Path, port: int) -> list[TrafficEvent]:
    traffic = CapturedTraffic([port])
    with path.open("rb") as stream:
        events = [event for packet in PacketFile(stream, path.name) for event in traffic.take(packet)]
    return events + traffic.finish()


def frames_in(path: Path, port: int) -> list[CapturedFrame]:
    return [event for event in events_in(path, port) if isinstance(event, CapturedFrame)]


def exchanges_in(path: Path, port: int) -> list[CapturedExchange]:
    exchanges = Exchanges()
    return [exchange for event in events_in(path, port) for exchange in exchanges.take(event)]


def tshark_frames(path: Path, port: int) -> list[tuple[int, int, int, int]]:
    """Packet, transaction, unit and function of each frame, as tshark sees them."""
    fields = ["frame.number", "mbtcp.trans_id", "mbtcp.unit_id", "modbus.func_code"]
    command = [program("tshark"), "-n", "-r", str(path), "-o", f"mbtcp.tcp.port:{port}", "-Y", "mbtcp", "-T", "fields"]
    for name in fields:
        command += ["-e", name]
    found = []
    for line in output_of(*command).splitlines():
        number, *columns = line.split("\t")
        rows = zip(*(column.split(",") for column in columns), strict=True)
        found += [(int(number), *(int(each, 0) for each in row)) for row in rows]
    return [(packet, transaction, unit, function & 0x7F) for packet, transaction, unit, function in found]


class Site:
    """A conversation between programs that are not ours, as dumpcap has captured it."""

    def __init__(self, path: Path, port: int) -> None:
        self.path = path
        self.port = port


def dumped(path: Path, port: int) -> "subprocess.Popen[str]":
    command = [program("dumpcap"), "-q", "-i", "lo", "-f", f"tcp port {port}", "-w", str(path)]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    said = ""
    while "File:" not in said:
        line = process.stderr.readline()
        if not line:
            process.wait()
            pytest.skip(f"this user may not capture: {said}")
        said += line
    return process


def wait_for_frames(path: Path, port: int, count: int) -> None:
    """Wait until a file has so many frames."""
    until = time.monotonic() + MORE_FRAMES
    found = 0
    while found < count:
        assert time.monotonic() < until, f"{found} of {count} frames were captured"
        time.sleep(0.05)
        try:
            found = len(frames_in(path, port))
        except (ConfigError, FileNotFoundError):
            continue


def mbpoll(port: int, *words: str) -> None:
    options = [word for word in words if not word.startswith("=")]
    values = [word.removeprefix("=") for word in words if word.startswith("=")]
    command = [program("mbpoll"), "-m", "tcp", "-p", str(port), "-a", "1", "-0", "-1", "-o", "5", *options]
    subprocess.run(
        [*command, "127.0.0.1", *values],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=foreign.LIMIT,
        check=False,
    )


POLLS: Sequence[Sequence[str]] = [
    ("-t", "4", "-r", "0", "-c", "10"),
    ("-t", "3", "-r", "5", "-c", "125"),
    ("-t", "0", "-r", "3", "-c", "20"),
    ("-t", "1", "-r", "0", "-c", "7"),
    ("-t", "4", "-r", "800", "=77"),
    ("-t", "4", "-r", "800", "=1", "=2", "=3"),
    ("-t", "4", "-r", "800", "-c", "3"),
    ("-t", "0", "-r", "810", "=1"),
    ("-t", "4", "-r", "999", "-c", "2"),
]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, libmodbus_server: foreign.Program) -> Site:
    """mbpoll and a client of ours, which asks several things at once, talk with a server of libmodbus."""
    path = tmp_path_factory.mktemp("captures") / "site.pcapng"
    port = int(libmodbus_server.ready)
    program("mbpoll")
    process = dumped(path, port)
    try:
        for words in POLLS:
            mbpoll(port, *words)
        with busway.connect(libmodbus_server.url) as link:
            unit = link.unit(1)
            unit.execute_many([busway.ReadHoldingRegisters(first, 5) for first in range(8)])
        wait_for_frames(path, port, 2 * (len(POLLS) + 8))
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=foreign.LIMIT)
    return Site(path, port)


def as_tshark_says(frames: Sequence[CapturedFrame]) -> list[tuple[int, int, int, int]]:
    return [(each.packet, each.transaction or 0, each.unit, each.pdu[0] & 0x7F) for each in frames]


def test_the_frames_of_a_capture_are_those_that_tshark_finds(site: Site) -> None:
    found = as_tshark_says(frames_in(site.path, site.port))
    assert found == tshark_frames(site.path, site.port)
    assert len(found) == 2 * (len(POLLS) + 8)


@pytest.mark.parametrize("form", ["pcap", "nsecpcap", "pcapng"])
@pytest.mark.parametrize("change", [(), ("-s", "80")])
def test_every_format_that_editcap_writes_has_the_same_frames(
    site: Site, tmp_path: Path, form: str, change: Sequence[str]
) -> None:
    path = tmp_path / "other.cap"
    output_of(program("editcap"), "-F", form, *change, site.path, path)
    found = as_tshark_says(frames_in(path, site.port))
    if "-s" in change:  # what was cut off is told, and the rest is found
        assert set(found) < set(as_tshark_says(frames_in(site.path, site.port)))
        assert len(found) >= len(POLLS)
    else:
        assert found == tshark_frames(path, site.port)


def test_a_merged_capture_has_all_frames_in_the_order_of_time(site: Site, tmp_path: Path) -> None:
    first, second, merged = (tmp_path / name for name in ("first.pcap", "second.pcapng", "merged.pcapng"))
    output_of(program("editcap"), "-F", "pcap", "-r", site.path, first, "1-20")
    output_of(program("editcap"), site.path, second, "1-20")
    output_of(program("mergecap"), "-w", merged, first, second)
    assert as_tshark_says(frames_in(merged, site.port)) == tshark_frames(merged, site.port)


def test_each_reply_is_paired_with_its_request_as_tshark_pairs_them(site: Site) -> None:
    pairs = [
        (each.asked.packet, each.answered.packet)
        for each in exchanges_in(site.path, site.port)
        if each.asked is not None and each.answered is not None
    ]
    assert len(pairs) == len(POLLS) + 8
    command = [program("tshark"), "-n", "-r", site.path, "-o", f"mbtcp.tcp.port:{site.port}", "-T", "fields"]
    lines = output_of(*command, "-Y", "modbus.request_frame", "-e", "modbus.request_frame", "-e", "frame.number")
    wanted = set()
    for line in lines.splitlines():
        asked, answered = line.split("\t")
        wanted |= {(int(each), int(answered)) for each in asked.split(",")}
    assert wanted <= set(pairs)
    exceptions = [each.exception for each in exchanges_in(site.path, site.port) if each.exception is not None]
    assert exceptions == [2]


def test_the_simulator_made_of_a_capture_answers_it_byte_for_byte(site: Site, tmp_path: Path) -> None:
    devices = RecordedDevices()
    exchanges = exchanges_in(site.path, site.port)
    for exchange in exchanges:
        devices.add(exchange)
    file = devices.file()
    path = tmp_path / "site.toml"
    path.write_text(file.text, encoding="utf-8")
    with simulated_device(path) as device:
        port = int(device.endpoints[0].rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), foreign.LIMIT) as connection:
            for exchange in exchanges:
                assert exchange.asked is not None
                assert exchange.answered is not None
                connection.sendall(exchange.asked.raw)
                wanted = exchange.answered.raw
                assert connection.recv(len(wanted), socket.MSG_WAITALL).hex(" ") == wanted.hex(" ")


FRAMES = [
    encode_rtu(unit, bytes.fromhex(pdu))
    for unit, pdu in ((7, "03 006b 0003"), (7, "03 06 022b 0000 0064"), (9, "06 0001 0003"), (9, "06 0001 0003"))
]


def test_frames_of_a_line_that_text2pcap_wrote_are_read_as_tshark_reads_them(tmp_path: Path) -> None:
    text, path = tmp_path / "line.txt", tmp_path / "line.pcap"
    broken = FRAMES[0][:-1] + bytes((FRAMES[0][-1] ^ 1,))
    packets = [*FRAMES, broken]
    lines = [f"{at:06x} {piece.hex(' ')}" for each in packets for at, piece in pieces(each, range(0, len(each), 16))]
    text.write_text("\n".join(lines) + "\n", encoding="ascii")
    output_of(program("text2pcap"), "-q", "-l", "147", "-F", "pcap", text, path)
    table = 'uat:user_dlts:"User 0 (DLT=147)","mbrtu","0","","0",""'
    command = [program("tshark"), "-n", "-r", path, "-o", table, "-o", "mbrtu.crc_verification:TRUE", "-T", "fields"]
    rows = output_of(*command, "-e", "mbrtu.unit_id", "-e", "mbrtu.crc16.status").splitlines()
    frames = frames_in(path, 502)
    assert [f"{each.unit}\t1" for each in frames] == rows[:4]
    assert rows[4].endswith("\t0")
    assert [each.direction for each in frames][:2] == [Direction.REQUEST, Direction.REPLY]
    assert [
        event.text for event in events_in(path, 502) if not isinstance(event, CapturedFrame) and hasattr(event, "text")
    ] == ["8 damaged bytes: no frame whose check fits"]
