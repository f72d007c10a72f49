"""Metrics of real servers, over real sockets: what was asked is counted once, and is shown as Prometheus reads it."""

import asyncio
import socket
import struct
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from examples import examples
from handlers import ScriptedHandler, address_of, registers
from hypothesis import given, settings
from hypothesis import strategies as st
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families as parse_text
from waiting import until

import busway
from busway.errors import ConfigError, LinkDown
from busway.observe.metrics import MetricsEndpoint, MetricsObserver, PeerClass, RequestTally, start_metrics
from busway.observe.metrics.observer import ClassifyByPriority
from busway.observe.metrics.request_tally import Unanswered
from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import CommunicationState, LineDiagnostics
from busway.session.responder import ClientIdentity
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession

FREE = "127.0.0.1:0"
FREE_TCP = "tcp://127.0.0.1:0"
OPENMETRICS = "application/openmetrics-text; version=1.0.0"


def get(url: str, accept: str = "") -> tuple[str, str]:
    """Text and content type of a scrape."""
    with urllib.request.urlopen(urllib.request.Request(url, headers={"Accept": accept}), timeout=60) as answer:
        return answer.read().decode(), answer.headers["Content-Type"]


async def samples(endpoint: MetricsEndpoint) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """What a scrape tells, by name and labels."""
    text, _ = await asyncio.to_thread(get, endpoint.url, OPENMETRICS)
    return {
        (one.name, tuple(sorted(one.labels.items()))): one.value
        for family in parse_openmetrics(text)
        for one in family.samples
    }


def of_name(found: dict[tuple[str, tuple[tuple[str, str], ...]], float], name: str) -> dict[Any, float]:
    """The samples of one name, by their labels."""
    return {labels: value for (each, labels), value in found.items() if each == name}


@pytest.fixture
def device() -> busway.Device:
    return busway.Device(holding_registers=10, coils=10)


async def test_a_scrape_is_understood_by_the_official_parsers_of_both_formats(device: busway.Device) -> None:
    server = busway.serve(FREE_TCP, units={1: device})
    async with start_metrics(server, FREE) as endpoint, server, busway.open(server.endpoints[0]) as link:
        await link.unit(1).read_holding_registers(0, count=1)
        for accept, parse, kind in (
            ("", parse_text, "text/plain"),
            (OPENMETRICS, parse_openmetrics, "application/openmetrics-text"),
        ):
            text, content_type = await asyncio.to_thread(get, endpoint.url, accept)
            assert content_type.startswith(kind)
            families = {family.name: family for family in parse(text)}
            for name, family in families.items():
                assert name.startswith("busway"), name
                assert family.documentation, name
            assert families["busway_request_duration_seconds"].type == "histogram"
            assert families["busway_up"].samples[0].value == 1


@pytest.mark.parametrize(
    "accept",
    [
        "application/openmetrics-text; version=abc",
        "application/openmetrics-text; version=1.0.0; version=;;;=",
        "application/openmetrics-text; version=1.x; escaping=\x7f",
        "text/plain; version=..",
        "=;,;=" * 200,
    ],
)
async def test_odd_accept_header_is_answered_with_a_format_and_no_traceback(
    device: busway.Device, accept: str, caplog: pytest.LogCaptureFixture
) -> None:
    server = busway.serve(FREE_TCP, units={1: device})
    async with start_metrics(server, FREE) as endpoint, server:
        text, _ = await asyncio.to_thread(get, endpoint.url, accept)
        assert "busway_up" in text
    assert not caplog.records


async def test_a_listener_without_connections_has_none_in_each_pool(device: busway.Device) -> None:
    server = busway.serve(FREE_TCP, units={1: device})
    async with start_metrics(server, FREE) as endpoint, server:
        found = await samples(endpoint)
    held = {dict(labels)["pool"]: value for labels, value in of_name(found, "busway_connections").items()}
    assert held == {"priority": 0, "other": 0}
    assert list(of_name(found, "busway_requests_waiting").values()) == [0]


async def test_requests_connections_bytes_and_time_are_told(device: busway.Device) -> None:
    server = busway.serve(FREE_TCP, units={1: device})
    async with start_metrics(server, FREE) as endpoint, server, busway.open(server.endpoints[0]) as link:
        for _ in range(3):
            await link.unit(1).read_holding_registers(0, count=1)
        await link.unit(1).write_single_register(3, 7)
        with pytest.raises(busway.ExceptionReply):
            await link.unit(1).read_holding_registers(9, count=2)
        found = await samples(endpoint)
    labels = {"peer_class": "other", "unit": "1"}
    expected = {("3", "none"): 3, ("6", "none"): 1, ("3", "02"): 1}
    assert of_name(found, "busway_requests_total") == {
        tuple(sorted({**labels, "function": function, "exception": exception}.items())): count
        for (function, exception), count in expected.items()
    }
    assert found["busway_request_duration_seconds_count", (("function", "3"),)] == 4
    assert found["busway_request_duration_seconds_bucket", (("function", "3"), ("le", "+Inf"))] == 4
    assert 0 < found["busway_request_duration_seconds_sum", (("function", "3"),)] < 10
    assert found["busway_received_requests_total", ()] == 5
    assert found["busway_connections_accepted_total", ()] == 1
    held = {dict(labels)["pool"]: value for labels, value in of_name(found, "busway_connections").items()}
    assert held == {"priority": 0, "other": 1}
    assert found["busway_uptime_seconds", ()] > 0
    indicators = {dict(labels)["indicator"]: dict(labels)["busway_listener_indicator"] for labels in lit(found)}
    assert indicators == {"communication": "on", "error": "off", "device_status": "on"}


def observed(
    responder: ScriptedHandler, observer: MetricsObserver, clock: Callable[[], float] = time.perf_counter
) -> busway.Server:
    """A server with an observer."""
    server = busway.serve(FREE_TCP, responder=responder)
    server._clock = clock
    server.observe(observer)
    return server


def lit(found: dict[Any, float]) -> list[Any]:
    """The labels of the indicator states that hold."""
    return [labels for labels, value in of_name(found, "busway_listener_indicator").items() if value]


ASKED = st.lists(
    st.tuples(st.sampled_from([1, 2, 9]), st.sampled_from(["read", "missing", "write", "coil", "unknown", "bad"])),
    min_size=1,
    max_size=30,
)
PDUS = {
    "read": bytes.fromhex("03 00 00 00 02"),
    "missing": bytes.fromhex("03 00 09 00 02"),
    "write": bytes.fromhex("10 00 00 00 01 02 00 07"),
    "coil": bytes.fromhex("05 00 01 FF 00"),
    "unknown": bytes.fromhex("41 00"),
    "bad": bytes.fromhex("03 00 00 00 00"),
}


def adu(transaction: int, unit: int, pdu: bytes) -> bytes:
    """A request on TCP."""
    return transaction.to_bytes(2, "big") + b"\0\0" + (len(pdu) + 1).to_bytes(2, "big") + bytes((unit,)) + pdu


async def replies(reader: asyncio.StreamReader, count: int) -> list[bytes]:
    """Unit and PDU of that many replies."""
    found = []
    for _ in range(count):
        head = await reader.readexactly(6)
        found.append(await reader.readexactly(int.from_bytes(head[4:], "big")))
    return found


@given(asked=ASKED, hooked=st.booleans())
@settings(max_examples=examples(25), deadline=None)
def test_every_answered_request_is_counted_exactly_once_by_whatever_path(
    asked: list[tuple[int, str]], hooked: bool
) -> None:
    async def run() -> None:
        device = busway.Device(holding_registers=10, coils=10)
        if hooked:
            device.on_write("holding_registers")(lambda change: None)
        server = busway.serve(FREE_TCP, units={1: device, 2: busway.Device(holding_registers=10)})
        with_metrics = start_metrics(server, FREE)
        async with with_metrics, server:
            host, _, port = server.endpoints[0].removeprefix("tcp://").rpartition(":")
            reader, writer = await asyncio.open_connection(host, int(port))
            # The same again, so that the second time everything that can take the fast path does.
            for _ in range(2):
                for number, (unit, kind) in enumerate(asked):
                    writer.write(adu(number, unit, PDUS[kind]))
                answers = await replies(reader, len(asked))
                seen.update(outcome(answer) for answer in answers)
            writer.close()
            await writer.wait_closed()
            counted = {(one.unit, one.function, one.exception): one.count for one in with_metrics.tally.all_series()}
        assert counted == dict(seen)
        assert sum(sum(one.counts) for one in with_metrics.tally.all_durations()) == 2 * len(asked)

    seen: Counter[tuple[str, str, str]] = Counter()
    asyncio.run(run())


def outcome(answer: bytes) -> tuple[str, str, str]:
    """The labels that an answer should be counted under."""
    function = answer[1] & 0x7F
    exception = f"{answer[2]:02X}" if answer[1] & 0x80 else "none"
    return str(answer[0]), "other" if function == 0x41 else str(function), exception


def test_known_reads_and_other_requests_of_the_fast_path_are_counted_with_the_time_of_their_call() -> None:
    now = [100.0]
    observer = MetricsObserver()

    def tick() -> float:
        now[0] += 3.0
        return now[0]

    device = busway.Device(holding_registers=10, coils=10)
    pipeline = RequestPipeline(DeviceResponder({1: device}), observers=[observer], clock=tick)
    session = TcpServerSession(
        pipeline, diagnostics=LineDiagnostics(), slots=ServerTransactionSlots(1), deliver=lambda adu: None
    )
    for _ in range(2):
        stream = adu(1, 1, PDUS["read"]) + adu(2, 1, PDUS["coil"]) + adu(3, 1, PDUS["read"])
        assert len(session.receive(stream, len(stream))) == 3
    assert not session.requests - 6
    assert {(one.function, one.count) for one in observer.tally.all_series()} == {("3", 4), ("5", 2)}
    assert {(one.function, round(one.total, 6)) for one in observer.tally.all_durations()} == {("3", 4.0), ("5", 2.0)}


@pytest.mark.parametrize("how", ["awaitable", "later"])
async def test_late_replies_are_counted_when_they_are_there_with_the_time_they_took(how: str) -> None:
    waiting: list[busway.RequestContext] = []
    opened = asyncio.Event()
    now = [100.0]

    async def answer() -> busway.Message:
        await opened.wait()
        now[0] += 2.0
        return registers(5)

    def decide(context: busway.RequestContext, request: Any) -> Any:
        waiting.append(context)
        return answer() if how == "awaitable" else busway.LATER

    handler = MetricsObserver()
    async with (
        observed(ScriptedHandler(decide), handler, clock=lambda: now[0]) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        reading = asyncio.ensure_future(link.unit(1).read_holding_registers(0, count=1))
        await until(lambda: waiting)
        assert handler.tally.total() == 0
        if how == "awaitable":
            opened.set()
        else:
            now[0] += 2.0
            waiting[0].reply(registers(5))
            waiting[0].reply(registers(6))
        assert await reading == [5]
    assert handler.tally.total() == 1
    (durations,) = handler.tally.all_durations()
    assert durations.total == 2.0


def reset_on_close(writer: asyncio.StreamWriter) -> None:
    """Have the connection end at once, and not one half of it after the other."""
    writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


async def test_a_client_that_goes_away_before_its_answer_is_counted_as_gone() -> None:
    contexts: list[busway.RequestContext] = []
    stopped: list[str] = []

    def decide(context: busway.RequestContext, request: Any) -> Any:
        contexts.append(context)
        context.gone = lambda: stopped.append("stopped")
        return busway.LATER

    handler = MetricsObserver()
    async with observed(ScriptedHandler(decide), handler) as server:
        host, _, port = server.endpoints[0].removeprefix("tcp://").rpartition(":")
        _, writer = await asyncio.open_connection(host, int(port))
        writer.write(adu(1, 1, PDUS["read"]))
        await until(lambda: contexts)
        reset_on_close(writer)
        writer.transport.abort()
        await until(lambda: not server.status().connections)
    contexts[0].reply(registers(1))
    assert stopped == ["stopped"]
    assert handler.tally.total() == 0
    assert handler.tally.unanswered_counts()[Unanswered.GONE] == 1


@pytest.mark.parametrize(
    ("decide", "exception"),
    [
        (lambda context, request: registers(address_of(request)), "none"),
        (lambda context, request: (context.reply(registers(1)), busway.LATER)[1], "none"),
        (lambda context, request: (context.reply(registers(1)), registers(2))[1], "none"),
        (lambda context, request: (context.refuse(6), registers(2))[1], "06"),
        (lambda context, request: (_ for _ in ()).throw(busway.Refusal(0x0A)), "0A"),
        (lambda context, request: (_ for _ in ()).throw(ValueError("a bug")), "04"),
    ],
    ids=["at once", "before it returns", "twice", "refused and answered", "refusal", "failure"],
)
async def test_a_request_has_one_outcome_whatever_the_handler_does(decide: Callable[..., Any], exception: str) -> None:
    handler = MetricsObserver()
    async with observed(ScriptedHandler(decide), handler) as server, busway.open(server.endpoints[0]) as link:
        try:
            await link.unit(1).read_holding_registers(0, count=1)
            answered = "none"
        except busway.ExceptionReply as error:
            answered = f"{error.code:02X}"
    assert answered == exception
    assert [(one.exception, one.count) for one in handler.tally.all_series()] == [(exception, 1)]


async def test_what_is_kept_silent_is_no_answer() -> None:
    handler = MetricsObserver()
    async with (
        observed(ScriptedHandler(lambda context, request: busway.SILENCE), handler) as server,
        busway.open(server.endpoints[0], timeout=0.05, retries=0) as link,
    ):
        with pytest.raises(busway.NoReply):
            await link.unit(1).read_holding_registers(0, count=1)
    assert handler.tally.total() == 0
    assert handler.tally.unanswered_counts()[Unanswered.SILENT] == 1


async def test_in_listen_only_mode_each_request_counts_as_one_without_an_answer(device: busway.Device) -> None:
    server = busway.serve(FREE_TCP, units={1: device}, diagnostics_changes=True)
    async with start_metrics(server, FREE) as endpoint, server:
        host, _, port = server.endpoints[0].removeprefix("tcp://").rpartition(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        # 08/04 mutes the unit, 03 reads, 03 is cut off, 00 is no function, 08/01 wakes the unit, 03 reads
        for pdu in ("08 00 04 00 00", "03 00 00 00 01", "03 00", "00", "08 00 01 00 00", "03 00 00 00 01"):
            writer.write(adu(1, 1, bytes.fromhex(pdu)))
        assert await replies(reader, 1) == [bytes.fromhex("01 03 02 00 00")]
        writer.close()
        await writer.wait_closed()
    assert endpoint.tally.total() == 1
    assert endpoint.tally.unanswered_counts()[Unanswered.SILENT] == 4


def test_a_broadcast_is_executed_by_each_unit_and_counts_as_no_answer(device: busway.Device) -> None:
    handler = MetricsObserver()
    pipeline = RequestPipeline(
        DeviceResponder({1: device, 2: busway.Device(holding_registers=10)}), observers=[handler]
    )
    executed: set[int] = set()
    for unit in (1, 2):
        context = busway.RequestContext(unit=unit, function=16, diagnostics=CommunicationState())
        context.executed = executed
        pipeline.answer(context, PDUS["write"], [])
    assert device.holding_registers[0] == 7
    assert handler.tally.unanswered_counts()[Unanswered.BROADCAST] == 2
    assert handler.tally.total() == 0


def test_priority_hosts_are_a_class_of_their_own() -> None:
    asked = []

    def is_priority(listener: str, host: str) -> bool:
        asked.append(host)
        return host in ("10.0.0.1", "fe80::1")

    classify = ClassifyByPriority(is_priority)
    peers = {
        "10.0.0.1:5": PeerClass.PRIORITY,
        "[fe80::1]:5": PeerClass.PRIORITY,
        "10.0.0.2:5": PeerClass.OTHER,
    }
    for _ in range(2):
        for peer, expected in peers.items():
            client = ClientIdentity(peer=peer, listener="tcp://x")
            assert classify(client) is expected
    assert asked == ["10.0.0.1", "fe80::1", "10.0.0.2"]
    line = ClientIdentity(peer="tty", listener="rtu:///dev/tty")
    assert classify(line) is PeerClass.LINE


async def test_requests_and_bytes_of_priority_connections_are_told_apart(device: busway.Device) -> None:
    server = busway.serve(FREE_TCP, units={1: device}, priority=["127.0.0.0/8"])
    async with start_metrics(server, FREE) as endpoint, server, busway.open(server.endpoints[0]) as link:
        await link.unit(1).read_holding_registers(0, count=1)
        found = await samples(endpoint)
    assert [dict(labels)["peer_class"] for labels in of_name(found, "busway_requests_total")] == ["priority"]
    assert found["busway_received_bytes_total", (("peer_class", "priority"),)] == 12
    assert found["busway_sent_bytes_total", (("peer_class", "priority"),)] == 11
    assert found["busway_sent_bytes_total", (("peer_class", "other"),)] == 0
    held = {dict(labels)["pool"]: value for labels, value in of_name(found, "busway_connections").items()}
    assert held == {"priority": 1, "other": 0}


async def test_a_server_that_is_not_metered_is_left_as_it_is(device: busway.Device) -> None:
    async with busway.serve(FREE_TCP, units={1: device}) as server:
        assert isinstance(server._responder, DeviceResponder)
        with pytest.raises(ConfigError, match="keeps its observers"):
            start_metrics(server, FREE)


async def test_an_event_loop_that_is_stuck_is_told_and_not_waited_for(
    device: busway.Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busway.observe.metrics.http_endpoint.ASK_SECONDS", 0.05)
    async with start_metrics(busway.serve(FREE_TCP, units={1: device}), FREE) as endpoint:
        # Scraped from the very thread that would have to tell.
        text, _ = get(endpoint.url)
    found = {one.name: one.value for family in parse_text(text) for one in family.samples}
    assert found["busway_up"] == 0
    assert "busway_uptime_seconds" not in found
    assert "busway_requests_unanswered_total" in found


async def test_a_source_without_a_status_is_told_with_the_counts_of_its_requests(
    device: busway.Device, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def failing() -> Any:
        raise RuntimeError("the status is broken")

    server = busway.serve(FREE_TCP, units={1: device})
    async with start_metrics(server, FREE) as endpoint, server, busway.open(server.endpoints[0]) as link:
        await link.unit(1).read_holding_registers(0, count=1)
        monkeypatch.setattr(server, "status", failing)
        found = await samples(endpoint)
    assert of_name(found, "busway_up") == {(): 0}
    assert sum(of_name(found, "busway_requests_total").values()) == 1
    assert [record.getMessage() for record in caplog.records if record.name == "busway.metrics"] == [
        "a scrape has no status: RuntimeError('the status is broken')"
    ]


async def test_a_scrape_goes_on_while_the_server_is_stopped(device: busway.Device) -> None:
    server = busway.serve(FREE_TCP, units={1: device})
    async with start_metrics(server, FREE) as endpoint:
        assert (await samples(endpoint))["busway_running", ()] == 0
        async with server:
            assert (await samples(endpoint))["busway_running", ()] == 1


async def test_closing_leaves_no_thread_and_no_socket(device: busway.Device) -> None:
    async with start_metrics(busway.serve(FREE_TCP, units={1: device}), FREE) as endpoint:
        assert [thread for thread in threading.enumerate() if thread.name == "busway metrics"]
        with pytest.raises(urllib.error.HTTPError, match="404"):
            await asyncio.to_thread(get, endpoint.url.replace("metrics", "other"))
    await endpoint.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "busway metrics"]
    with pytest.raises(urllib.error.URLError, match="refused"):
        await asyncio.to_thread(get, endpoint.url)
    again = start_metrics(
        busway.serve(FREE_TCP, units={1: device}), endpoint.url.removeprefix("http://").partition("/")[0]
    )
    await again.close()


async def test_an_address_that_cannot_be_is_named(device: busway.Device) -> None:
    server = busway.serve(FREE_TCP, units={1: device})
    with pytest.raises(ConfigError, match="metrics: an address such as"):
        start_metrics(server, "nowhere")
    async with start_metrics(server, FREE) as endpoint:
        taken = endpoint.url.removeprefix("http://").partition("/")[0]
        with pytest.raises(LinkDown, match=taken):
            start_metrics(server, taken)


@pytest.fixture
def without_prometheus(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    return


@pytest.mark.usefixtures("without_prometheus")
async def test_without_the_package_the_way_to_it_is_named(device: busway.Device) -> None:
    with pytest.raises(ConfigError, match=r"pip install 'busway\[metrics\]'"):
        start_metrics(busway.serve(FREE_TCP, units={1: device}), FREE)


async def test_what_a_policy_refuses_is_told_by_its_rule(device: busway.Device) -> None:
    """The count of all is there before the first refusal: Prometheus sees no increase in a series that is new."""
    from busway.access.rules import Policy

    server = busway.serve(FREE_TCP, units={1: device}, policy=Policy.read_only())
    async with start_metrics(server, FREE) as endpoint, server, busway.open(server.endpoints[0]) as link:
        found = await samples(endpoint)
        assert found["busway_requests_denied_total", ()] == 0
        assert not of_name(found, "busway_policy_refusals_total")
        for _ in range(2):
            with pytest.raises(busway.ExceptionReply):
                await link.unit(1).write_single_register(0, 1)
        await link.unit(1).read_holding_registers(0, count=1)
        found = await samples(endpoint)
    assert found["busway_requests_denied_total", ()] == 2
    assert list(of_name(found, "busway_policy_refusals_total").values()) == [2]
    counted = {dict(labels)["exception"]: value for labels, value in of_name(found, "busway_requests_total").items()}
    assert counted == {"01": 2, "none": 1}


async def test_the_links_of_this_process_are_told(device: busway.Device) -> None:
    from busway.client.open_connections import local_connections

    server = busway.serve(FREE_TCP, units={1: device})
    async with start_metrics(server, FREE, links=local_connections) as endpoint, server:
        async with busway.open(server.endpoints[0]) as link:
            await link.unit(1).read_holding_registers(0, count=1)
            found = await samples(endpoint)
        name = ("endpoint", server.endpoints[0])
        assert found["busway_link_transactions_total", (name,)] == 1
        assert found["busway_links", (name, ("state", "up"))] == 1
        assert found["busway_link_sent_bytes_total", (name,)] == 12


def test_a_tally_can_be_shared_and_units_left_out() -> None:
    tally = RequestTally(units=False)
    handler = MetricsObserver(tally)
    assert handler.tally is tally
    tally.series(PeerClass.OTHER, 1, 3).count += 1
    tally.series(PeerClass.OTHER, 2, 3).count += 1
    assert [(one.unit, one.count) for one in tally.all_series()] == [("", 2)]
