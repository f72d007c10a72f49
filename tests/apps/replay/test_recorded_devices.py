"""Simulation files made of captures: served, and asked what the capture asked."""

import socket
from collections.abc import Sequence
from ipaddress import IPv6Address
from pathlib import Path

import pytest
from captured import SERVER, Talk, captured
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from busway.apps.replay.exchanges import Exchanges
from busway.apps.replay.recorded_devices import RecordedDevices
from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.errors import ConfigError
from busway.observe.capture_files.frame_extraction import CapturedTraffic
from busway.observe.capture_files.packet_file import CapturedPacket
from busway.observe.capture_headers import Node
from busway.testing import simulated_device

CONVERSATION = [
    ("01 03 006b 0002", "01 03 04 022b 0064"),
    ("01 06 006b 0007", "01 06 006b 0007"),
    ("01 03 006b 0001", "01 03 02 0007"),
    ("01 16 006b 00f2 0025", "01 16 006b 00f2 0025"),
    ("01 03 006b 0002", "01 03 04 0007 0064"),
    ("01 01 0000 000a", "01 01 02 cd01"),
    ("01 05 0003 0000", "01 05 0003 0000"),
    ("01 01 0000 000a", "01 01 02 c501"),
    ("01 0f 0004 0003 01 05", "01 0f 0004 0003"),
    ("01 02 0010 0001", "01 02 01 01"),
    ("01 03 0000 0005", "01 83 02"),
    ("01 06 006c 0001", "01 86 04"),
    ("01 17 006b 0001 006b 0001 02 0009", "01 17 02 0009"),
    ("01 10 006b 0001 02 0001", "01 90 01"),
    ("01 11", "01 11 03 42 37 ff"),
    ("01 07", "01 07 6d"),
    ("01 2b 0e 01 00", "01 2b 0e 01 81 00 00 03 00 04 41636d65 01 02 5031 02 03 312e32"),
    ("01 2b 0d 01", "01 ab 01"),
    ("01 64 01", "01 e4 01"),
    ("02 04 0001 0001", "02 04 02 ffff"),
    ("02 04 0003 0001", "02 04 02 0001"),
    ("02 04 0002 0001", "02 84 02"),
]


def frame(number: int, text: str) -> bytes:
    body = bytes.fromhex(text)
    return number.to_bytes(2, "big") + b"\0\0" + len(body).to_bytes(2, "big") + body


def spoken(*pairs: tuple[str, str], server: Node = SERVER) -> Talk:
    talk = Talk(server=server)
    for number, (asked, answered) in enumerate(pairs, 1):
        talk.says(True, frame(number, asked))
        if answered:
            talk.says(False, frame(number, answered))
    talk.time += 60
    talk.says(True, frame(999, "01 07"))
    return talk


def recorded(*talks: Talk) -> RecordedDevices:
    return recorded_packets(captured(packet for talk in talks for packet in talk.packets))


def recorded_packets(packets: Sequence[CapturedPacket]) -> RecordedDevices:
    traffic, exchanges, devices = CapturedTraffic(), Exchanges(), RecordedDevices()
    events = [event for packet in packets for event in traffic.take(packet)] + traffic.finish()
    for event in events:
        for exchange in exchanges.take(event):
            devices.add(exchange)
    return devices


def asked_again(path: Path, requests: Sequence[bytes]) -> list[bytes]:
    """The replies of the simulator that plays a file."""
    with simulated_device(path) as device:
        port = int(device.endpoints[0].rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), 60) as connection:
            found = []
            for request in requests:
                connection.sendall(request)
                head = connection.recv(6, socket.MSG_WAITALL)
                found.append(head + connection.recv(int.from_bytes(head[4:], "big"), socket.MSG_WAITALL))
            return found


def test_the_simulator_answers_the_requests_of_the_capture_byte_for_byte(tmp_path: Path) -> None:
    file = recorded(spoken(*CONVERSATION)).file()
    path = tmp_path / "site.toml"
    path.write_text(file.text, encoding="utf-8")
    requests = [frame(number, asked) for number, (asked, _) in enumerate(CONVERSATION, 1)]
    wanted = [frame(number, answered) for number, (_, answered) in enumerate(CONVERSATION, 1)]
    assert [each.hex(" ") for each in asked_again(path, requests)] == [each.hex(" ") for each in wanted]
    assert (file.units, file.server) == ([1, 2], "10.0.0.5:502")


def test_the_last_values_are_those_of_the_end(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text(recorded(spoken(*CONVERSATION)).file(last=True).text, encoding="utf-8")
    assert asked_again(path, [frame(1, "01 03 006b 0002")]) == [frame(1, "01 03 04 0009 0064")]


def test_units_that_did_not_answer_are_left_out_and_silent() -> None:
    file = recorded(spoken(("01 03 0000 0001", "01 03 02 0001"), ("07 03 0000 0001", ""))).file()
    assert file.units == [1]
    assert 'unlisted = "silence"' in file.text
    assert "left out, they did not answer: units 7" in file.remarks


def test_units_for_which_a_gateway_answered_are_left_out() -> None:
    file = recorded(spoken(("01 03 0000 0001", "01 03 02 0001"), ("07 03 0000 0001", "07 83 0b"))).file()
    assert file.units == [1]
    assert "silence" not in file.text


def test_the_typical_delay_is_a_fault_where_it_is_asked_for() -> None:
    devices = recorded(spoken(*CONVERSATION))
    assert 'fault_profile = "late"' not in devices.file().text
    assert "delay = 0.01" in devices.file(delays=True).text


def test_what_the_file_cannot_say_is_a_remark() -> None:
    pairs = [
        ("01 03 0000 0001", "01 03 02 0001"),
        ("01 03 0000 0001", "01 03 02 0002"),
        ("01 18 0000", "01 18 0004 0001 0005"),
        ("01 06 0000 0005", "01 06 0000 0005"),
        ("01 06 0000 0005", "01 86 06"),
        ("01 03 0000 0002", "01 03 04 0005 0000"),
        ("01 04 0000 0001", "01 04 02 0000"),
        ("01 04 0001 0001", "01 04 02 0000"),
        ("01 04 0000 0002", "01 84 03"),
    ]
    assert recorded(spoken(*pairs)).file().remarks == [
        "unit 1: 1 item changed; the file has one value of each",
        "unit 1: function 24 (read fifo queue) was answered and is not recorded",
        "unit 1: answered and also refused, now answered: 1 request",
        "unit 1: exception 03 to 4 (read input registers), for items that it gave elsewhere",
    ]


def test_one_of_several_servers_is_chosen_by_its_address() -> None:
    pair = ("01 03 0000 0001", "01 03 02 0001")
    other = Node(SERVER.address + 1, 502)
    devices = recorded(spoken(pair), spoken(pair, server=other))
    with pytest.raises(ConfigError, match=r"there are several: 10\.0\.0\.5:502, 10\.0\.0\.6:502"):
        devices.file()
    with pytest.raises(ConfigError, match=r"no unit of 10\.0\.0\.7 answered"):
        devices.file("10.0.0.7")
    assert devices.file("10.0.0.6").server == devices.file("10.0.0.6:502").server == "10.0.0.6:502"


def test_a_serial_line_is_chosen_by_its_whole_name_alone() -> None:
    frames = ["01 03 00 00 00 01 84 0a", "01 03 02 00 01 79 84"]  # read 4x1; it is 1
    packets = [
        CapturedPacket(2 * line + place + 1, place / 10, 147, bytes.fromhex(text), interface=line, interface_name=name)
        for line, name in enumerate(["/dev/ttyS0", "rtu:/dev/ttyS1"])
        for place, text in enumerate(frames)
    ]
    devices = recorded_packets(packets)
    for part in ("", "rtu"):
        with pytest.raises(ConfigError, match=f"no unit of {part} answered"):
            devices.file(part)
    assert devices.file("/dev/ttyS0").server == "/dev/ttyS0"
    assert devices.file("rtu:/dev/ttyS1").server == "rtu:/dev/ttyS1"


def test_a_server_with_an_address_of_version_6_is_chosen_without_brackets() -> None:
    server = Node(IPv6Address("fe80::2"), 502)
    talk = spoken(("01 03 0000 0001", "01 03 02 0001"), server=server)
    talk.client = Node(IPv6Address("fe80::9"), 40_000)
    assert recorded(talk).file("fe80::2").server == "[fe80::2]:502"


def test_a_capture_without_a_reply_gives_no_file() -> None:
    with pytest.raises(ConfigError, match="no unit answered"):
        recorded(spoken(("01 03 0000 0001", ""))).file()


def test_what_is_recorded_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.apps.replay.recorded_devices.MOST_ITEMS", 3)
    file = recorded(spoken(("01 03 0000 0005", "01 03 0a 00010002000300040005"))).file()
    assert "count = 3" in file.text
    assert "the capture has more items or requests than are recorded" in file.remarks


PDUS = st.one_of(
    st.binary(min_size=1, max_size=8),
    st.builds(
        lambda code, address, count: bytes((code,)) + address.to_bytes(2, "big") + count.to_bytes(2, "big"),
        st.sampled_from([1, 2, 3, 4, 5, 6, 24, 43, 130]),
        st.sampled_from([0, 1, 5, 65_535]),
        st.sampled_from([0, 1, 3, 0xFF00]),
    ),
)
ANSWERS = st.one_of(
    st.binary(min_size=1, max_size=8),
    st.builds(lambda code, exception: bytes((code | 0x80, exception)), st.integers(1, 127), st.integers(0, 12)),
    st.sampled_from(["03 02 0001", "03 06 0001 0002 0003", "01 01 05", "04 02 0000", "06 0001 0003"]).map(
        bytes.fromhex
    ),
)


@settings(max_examples=examples(50))
@given(st.lists(st.tuples(st.sampled_from([0, 1, 255]), PDUS, ANSWERS), max_size=10), st.booleans())
def test_any_conversation_gives_a_file_that_can_be_loaded_or_a_sentence(
    said: list[tuple[int, bytes, bytes]], flag: bool
) -> None:
    pairs = [(bytes((unit, *asked)).hex(), bytes((unit, *answered)).hex()) for unit, asked, answered in said]
    devices = recorded(spoken(*pairs))
    try:
        file = devices.file(last=flag, delays=flag)
    except ConfigError as error:
        assert "no unit answered" in error.message  # noqa: PT017 - the other outcome is as good
        return
    Simulation(parse_declaration(file.text, "plant.toml"))
