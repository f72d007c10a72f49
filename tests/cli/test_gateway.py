"""`busway gateway` as a process: the common case, files, who may do what, reading again, the end, status, metrics."""

import json
import re
import signal
import socket
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from control_sockets import short_directory
from program import LIMIT, Busway
from whole_frames import line_of_whole_frames

import busway
from busway.apps.control import Running, ask, parse_control_address
from busway.testing.certificates import CertificateStore

LOOPBACK = "tcp://127.0.0.1:0"
NETWORK = "tcp://0.0.0.0:0"
BAUD = 115_200

FILE = """\
[[listener]]
name = "office"
url = "{listener}"

[[link]]
name = "hall"
url = "{line}"
timeout = 0.3
retries = 0

[[route]]
units = "{units}"
link = "hall"
"""


@contextmanager
def running(*arguments: str, control: str = "off") -> Iterator[tuple[Busway, list[str]]]:
    """The running process, and URLs of this host at which it answers."""
    with Busway("gateway", *arguments, "--control", control) as program:
        stdout = program.process.stdout
        assert stdout is not None
        listeners = sum("://" in one for one in arguments) - 1 if "://" in arguments[0] else 1
        endpoints = [stdout.readline().decode().strip() for _ in range(listeners)]
        assert all(endpoints), program.end()[1]
        yield program, [endpoint.replace("0.0.0.0", "127.0.0.1") for endpoint in endpoints]


def device() -> busway.Device:
    return busway.Device(holding_registers=[100 + n for n in range(20)], coils=16)


@contextmanager
def serial_line(units: tuple[int, ...] = (1,)) -> Iterator[tuple[str, busway.Device]]:
    """A paced line with devices at its far end: URL of the near end, and the device."""
    with line_of_whole_frames(ports=2, baud=BAUD) as line:
        near, far = (f"rtu://{path}?baud={BAUD}" for path in line.paths)
        behind = device()
        with busway.serve_in_thread(far, units=dict.fromkeys(units, behind)):
            yield near, behind


@contextmanager
def tcp_device(*units: int) -> Iterator[str]:
    with busway.serve_in_thread(LOOPBACK, units={unit: device() for unit in units or (1,)}) as server:
        yield server.endpoints[0]


@pytest.fixture
def write_file(tmp_path: Path) -> Callable[..., Path]:
    """Writes a gateway file."""

    def write(line: str, *, listener: str = LOOPBACK, units: str = "1", rest: str = "") -> Path:
        file = tmp_path / "plant.toml"
        file.write_text(FILE.format(listener=listener, line=line, units=units) + rest)
        return file

    return write


def read_first(url: str, unit: int = 1, **options: object) -> int:
    with busway.connect(url, shared=False, **options) as link:
        return link.unit(unit).read_holding_registers(0, count=1)[0]


def write(url: str) -> str:
    """Write a register: ``done``, or why not."""
    with busway.connect(url, shared=False, retries=0) as link:
        assert link.unit(1).read_holding_registers(0, count=1) is not None
        try:
            link.unit(1).write_single_register(0, 7)
        except busway.ExceptionReply as error:
            return f"exception {error.code:02X}"
        return "done"


@pytest.mark.clause("T24")
@pytest.mark.clause("T32")
@pytest.mark.real_time
def test_urls_are_enough_for_the_common_case() -> None:
    with serial_line() as (line, behind), running(LOOPBACK, "rtu+tcp://127.0.0.1:0", line) as (program, urls):
        for url in urls:
            with busway.connect(url, shared=False) as link:
                assert link.unit(1).read_holding_registers(3, count=2) == [103, 104]
                link.unit(1).write_single_register(0, 7)
                behind.holding_registers[0] += 1
        assert behind.holding_registers[0] == 8
        with busway.connect(urls[0], shared=False) as link:
            assert link.unit(255).read_device_identification()[1] == b"gateway"
            with pytest.raises(busway.ExceptionReply, match=r"exception 01, .*; unit 255 was assumed"):
                link.unit().read("3x1", "float32")  # what the gateway says of itself is no value of a device
        out, said = program.stop(signal.SIGTERM)
        assert (program.process.returncode, out, said) == (0, "", "")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["tcp://127.0.0.1:0"], "add the URL of a serial line or server to forward to"),
        (["tcp://127.0.0.1:0", "plant.toml"], "either URLs or one file"),
        (["/not/there.toml"], "/not/there.toml: cannot be read: no such file"),
        (["tcp://127.0.0.1:0", "tcp://10.0.0.5?speed=3"], "speed: unknown option"),
        (["check"], "check needs one file"),
        (
            ["tcp://127.0.0.1:0", "tcp://10.0.0.5", "--client-deadline", "0"],
            "--client-deadline: a time of 0.001…3600 s",
        ),
        (["plant.toml", "--client-deadline", "2s"], "--client-deadline: goes with URLs"),
        (["tcp://127.0.0.1:0", "tcp://10.0.0.5", "--allow", "x"], "--allow"),
    ],
)
def test_what_cannot_be_ends_with_code_2_and_a_sentence(arguments: list[str], sentence: str) -> None:
    with Busway("gateway", *arguments) as program:
        out, said = program.end()
    assert (program.process.returncode, out) == (2, "")
    assert sentence in said
    assert "Traceback" not in said


def test_a_port_that_is_taken_ends_with_code_5() -> None:
    with tcp_device() as url, Busway("gateway", url, "tcp://10.0.0.5", "--control", "off") as program:
        _, said = program.end()
        assert program.process.returncode == 5
        assert "the port is taken" in said


def test_check_prints_the_routing_table_and_what_is_odd(write_file: Callable[..., Path]) -> None:
    file = write_file("rtu:///dev/not-there", rest='[[link]]\nname = "spare"\nurl = "tcp://10.0.0.5"\n')
    with Busway("gateway", "check", str(file)) as program:
        out, said = program.end()
    assert program.process.returncode == 0
    assert re.search(r"^all +1 +all +all +hall$", out, re.MULTILINE)
    assert "timeout 0.3 s" in out
    assert said == f"{file}:15: link[1].name: warning: no route leads to 'spare'\n"


def test_check_refuses_what_cannot_work_with_line_and_key(write_file: Callable[..., Path]) -> None:
    twice = '[[route]]\nunits = "1"\nlink = "hall"\n'
    file = write_file("rtu:///dev/not-there", rest=twice)
    file.write_text(file.read_text().replace('name = "office"', 'name = "office"\nclient_deadline = 0.2'))
    for arguments in (["check", str(file)], [str(file)]):
        with Busway("gateway", *arguments) as program:
            out, said = program.end()
        assert (program.process.returncode, out) == (2, "")
        first, second = said.splitlines()
        assert first.startswith(
            f"{file}:3: listener[0].client_deadline: 0.2 s is less than link 'hall' may take: 0.497 s"
        )
        assert second == f"{file}:15: route[1]: is never reached: route[0] before it takes all its requests"


def test_a_gateway_of_urls_that_starts_logs_that_its_upstream_may_take_longer_than_clients_are_answered() -> None:
    with running(LOOPBACK, "tcp://127.0.0.1:9?timeout=3") as (program, _):
        _, said = program.stop(signal.SIGTERM)
    (warning,) = said.splitlines()
    assert warning.startswith("busway gateway: warning: link 'line' may take 6 s = (1 + 1 retry) × (3 s timeout), and")
    assert "(beside URLs: --client-deadline)" in warning


def test_a_gateway_that_reads_its_file_logs_what_the_check_warns_of_once(write_file: Callable[..., Path]) -> None:
    spare = '[[link]]\nname = "spare"\nurl = "tcp://10.0.0.5"\n'
    file = write_file("tcp://127.0.0.1:9", rest=spare)
    with running(str(file)) as (program, _):
        first = program.wait_for("warning")
        write_file("tcp://127.0.0.1:9", rest=spare + spare.replace("spare", "other").replace("0.5", "0.6"))
        program.process.send_signal(signal.SIGHUP)
        second = program.wait_for("warning")
        program.wait_for("read again")
        _, rest = program.stop(signal.SIGTERM)
    assert first == f"{file}:15: link[1].name: warning: no route leads to 'spare'"
    assert second == f"{file}:18: link[2].name: warning: no route leads to 'other'"
    assert "warning" not in rest


@pytest.mark.clause("T20")
def test_a_listener_that_the_network_reaches_is_read_only_without_a_policy_and_the_command_says_so() -> None:
    with tcp_device() as line, running(NETWORK, LOOPBACK, line) as (program, (network, loopback)):
        assert write(network) == "exception 01"
        assert write(loopback) == "done"
        said = program.wait_for("read-only")
        assert re.fullmatch(
            r"busway: read-only, for want of a policy: tcp://0\.0\.0\.0:\d+; --allow-writes takes writes", said
        )
    with tcp_device() as line, running(NETWORK, line, "--allow-writes") as (program, (network,)):
        assert write(network) == "done"


def test_lists_of_who_may_connect_hold_at_every_listener() -> None:
    with (
        tcp_device() as line,
        running(LOOPBACK, "tcp://[::1]:0", line, "--deny", "127.0.0.0/8") as (_, (fourth, sixth)),
    ):
        assert read_first(sixth) == 100
        with pytest.raises((busway.LinkDown, busway.NoReply)):
            read_first(fourth, retries=0)


@pytest.mark.real_time
def test_the_audit_log_has_a_line_for_each_write_through_the_gateway(tmp_path: Path) -> None:
    log = tmp_path / "audit.jsonl"
    with (
        serial_line() as (line, _),
        running(LOOPBACK, "udp://127.0.0.1:0", line, "--audit", str(log)) as (program, urls),
    ):
        assert [write(url) for url in urls] == ["done", "done"]
        program.stop(signal.SIGTERM)
    entries = [json.loads(line) for line in log.read_text().splitlines()]
    assert len(entries) == 2
    for entry, url in zip(entries, urls, strict=True):
        assert entry["old"] is None  # a gateway does not know what it replaces
        assert entry["new"] == [7]
        assert entry["listener"] == url


@pytest.mark.clause("M6")
@pytest.mark.real_time
def test_roles_decide_at_a_secure_listener_what_reaches_the_serial_line(
    tmp_path: Path, write_file: Callable[..., Path]
) -> None:
    store = CertificateStore(tmp_path)
    server = store.server()
    options = "".join(f'{name} = "{value}"\n' for name, value in server.options().items())
    rest = f"""\
[security]
{options}
[policy]
default = "read-only"

[[policy.rule]]
name = "operators"
roles = ["operator"]
action = "allow"
"""
    with serial_line() as (line, behind):
        file = write_file(line, listener="tls://127.0.0.1:0", rest=rest)
        with running(str(file)) as (_, (url,)):
            place = url.replace("127.0.0.1", "localhost")
            for role, outcome in (("operator", "done"), ("guest", "exception 01"), (None, "exception 01")):
                client = store.client(f"client {role}", role=role)
                assert write(f"{place}?{client.query()}") == outcome
                assert behind.holding_registers[0] == 7


@pytest.mark.clause("T33")
def test_sighup_changes_routes_and_keeps_connections(write_file: Callable[..., Path]) -> None:
    with tcp_device(1, 2) as line:
        file = write_file(line, units="1")
        with running(str(file)) as (program, (url,)), busway.connect(url, shared=False) as link:
            assert link.unit(1).read_holding_registers(0, count=1) == [100]
            with pytest.raises(busway.ExceptionReply, match="exception 0A"):
                link.unit(2).read_holding_registers(0, count=1)
            write_file(line, units="1-2")
            program.process.send_signal(signal.SIGHUP)
            assert program.wait_for("read again") == "busway: read again: 1 routes"
            assert link.unit(2).read_holding_registers(0, count=1) == [100]
            write_file(line, units="1-2", rest='[[route]]\nunits = "2"\nlink = "hall"\n')
            program.process.send_signal(signal.SIGHUP)
            assert program.wait_for("read again") == "busway: read again, nothing was changed:"
            said = program.wait_for("route[1]")
            assert said == f"{file}:14: route[1]: is never reached: route[0] before it takes all its requests"
            assert link.unit(2).read_holding_registers(0, count=1) == [100]
            assert link.counters.connections == 1


@contextmanager
def silent_peer() -> Iterator[tuple[str, Callable[[], socket.socket]]]:
    """A server that accepts, and answers when the test lets it."""
    with ExitStack() as stack:
        listening = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        listening.settimeout(LIMIT)

        def accepted() -> socket.socket:
            connection, _ = listening.accept()
            connection.settimeout(LIMIT)
            return stack.enter_context(connection)

        yield f"tcp://127.0.0.1:{listening.getsockname()[1]}?timeout=15&retries=0", accepted


def test_sigterm_lets_what_was_asked_be_answered_and_takes_nothing_new() -> None:
    with silent_peer() as (line, accepted), running(LOOPBACK, line) as (program, (url,)), ThreadPoolExecutor() as pool:
        asked = pool.submit(read_first, url, timeout=15)
        peer = accepted()
        request = peer.recv(100)
        program.process.send_signal(signal.SIGTERM)
        assert "ends when 1 request is answered, within 5 s" in program.wait_for("is answered")
        peer.sendall(request[:4] + bytes.fromhex("0005") + request[6:7] + bytes.fromhex("03 02 1234"))
        assert asked.result(LIMIT) == 0x1234
        out, said = program.end()
        assert (program.process.returncode, out, said) == (0, "", "")


def test_a_second_signal_ends_it_at_once_and_says_what_is_left() -> None:
    with silent_peer() as (line, accepted), running(LOOPBACK, line) as (program, (url,)), ThreadPoolExecutor() as pool:
        asked = pool.submit(read_first, url, timeout=15, retries=0)
        accepted().recv(100)
        program.process.send_signal(signal.SIGTERM)
        program.wait_for("another signal ends it at once")
        _, said = program.stop(signal.SIGTERM)
        assert program.process.returncode == 0
        assert "left unanswered: 1 request" in said
        with pytest.raises(busway.LinkDown):
            asked.result(LIMIT)


def test_the_deadline_of_the_file_ends_it_too(write_file: Callable[..., Path]) -> None:
    with silent_peer() as (line, accepted):
        file = write_file(line.partition("?")[0], rest="[gateway]\ndrain = 0.05\n")
        file.write_text(file.read_text().replace("timeout = 0.3", "timeout = 15"))
        with running(str(file)) as (program, (url,)), ThreadPoolExecutor() as pool:
            asked = pool.submit(read_first, url, timeout=15, retries=0)
            accepted().recv(100)
            program.process.send_signal(signal.SIGTERM)
            assert program.wait_for("left") == "busway: left unanswered: 1 request"
            with pytest.raises(busway.LinkDown):
                asked.result(LIMIT)
            program.end()
            assert program.process.returncode == 0


def test_a_service_manager_is_told_of_start_reading_and_end(
    monkeypatch: pytest.MonkeyPatch, write_file: Callable[..., Path]
) -> None:
    with (
        short_directory() as folder,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver,
        tcp_device() as line,
    ):
        receiver.settimeout(LIMIT)
        receiver.bind(str(folder / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(folder / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "60000000")
        monkeypatch.delenv("WATCHDOG_PID", raising=False)

        def told() -> str:
            return receiver.recv(4096).decode()

        with running(str(write_file(line))) as (program, (url,)):
            first = {told(), told()}
            assert first == {"WATCHDOG=1", f"READY=1\nSTATUS={url} to hall"}
            write_file(line, units="1-2")
            program.process.send_signal(signal.SIGHUP)
            assert told().startswith("RELOADING=1\nMONOTONIC_USEC=")
            assert told().startswith("READY=1\n")
            program.stop(signal.SIGTERM)
            assert told() == "STOPPING=1\nSTATUS=0 requests to answer"


@pytest.mark.clause("T34")
@pytest.mark.real_time
def test_status_shows_listeners_lines_and_units_that_are_not_asked() -> None:
    with short_directory() as folder, serial_line() as (line, _):
        control = str(folder / "control")
        options = "&timeout=0.5&retries=0&first_pause=60&longest_pause=60"
        with running(LOOPBACK, line + options, control=control) as (_, (url,)):
            with busway.connect(url, shared=False, retries=0) as link:
                assert link.unit(1).read_holding_registers(0, count=1) == [100]
                for _ in range(4):
                    with pytest.raises(busway.ExceptionReply, match="exception 0B"):
                        link.unit(9).read_holding_registers(0, count=1)
                status = ask(Running(parse_control_address(control)))["status"]
            (listener,), (told,) = status["gateway_listeners"], status["upstreams"]
            assert listener["server"]["endpoints"] == [url]
            assert told["counters"]["no_answer"] == 4
            (unit,) = told["links"][0]["suspended"]
            assert (unit["unit"], unit["state"]) == (9, "open")
            assert 0 < unit["next_probe"] <= 60
            with Busway("status", control) as program:
                out, _ = program.end()
            assert program.process.returncode == 0
            assert out.startswith(f"gateway on {url}: up ")
            assert re.search(r"^line  unit 9  does not answer  asked again in \d+ s$", out, re.MULTILINE)


def test_metrics_tell_of_listeners_and_lines_and_count_the_requests_of_all_listeners() -> None:
    with tcp_device() as line, running(LOOPBACK, LOOPBACK, line, "--metrics", "127.0.0.1:0") as (program, urls):
        place = re.search(r"http://\S+", program.wait_for("metrics"))
        assert place is not None
        for url in urls:
            assert write(url) == "done"
        with urllib.request.urlopen(place[0], timeout=60) as answer:
            text = answer.read().decode()
        assert 'busway_upstream_forwarded_total{upstream="line"} 4.0' in text
        assert 'busway_upstream_answered_total{upstream="line"} 4.0' in text
        assert 'busway_upstream_connections{state="up",upstream="line"} 1.0' in text
        assert 'busway_upstream_queued{upstream="line"} 0.0' in text
        assert 'busway_upstream_late_replies_total{upstream="line"} 0.0' in text
        assert 'busway_upstream_markers_total{upstream="line"} 0.0' in text
        assert 'busway_upstream_units_in_doubt{upstream="line"} 0.0' in text
        assert f'busway_gateway_listener_no_route_total{{listener="{LOOPBACK}"}} 0.0' in text
        assert 'busway_requests_total{exception="none",function="6",peer_class="other",unit="1"} 2.0' in text


def test_the_unit_file_for_systemd_starts_what_the_same_words_start(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(FILE.format(listener=LOOPBACK, line="rtu:///dev/not-there", units="1"))
    options = ["--policy", "read-only", "--audit=a.jsonl", "--control", "off"]
    with Busway("gateway", "--systemd-unit", str(file), *options) as program:
        out, said = program.end()
    assert (program.process.returncode, said) == (0, "")
    (start,) = re.findall(r"^ExecStart=(.*)$", out, re.MULTILINE)
    log = Path("a.jsonl").absolute()
    assert start.endswith(f"gateway {file} --policy read-only --audit {log} --control off")
    assert f"ReadWritePaths={log.parent}\n" in out
    with Busway("gateway", LOOPBACK, "tcp://10.0.0.5", "--systemd-unit") as program:
        out, _ = program.end()
    assert f"gateway {LOOPBACK} tcp://10.0.0.5 --control /run/busway/gateway.sock\n" in out


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (["--control=/tmp/x.sock"], "/tmp/x.sock"),
        (["--control", "x.sock"], str(Path("x.sock").absolute())),
        (["--control=x.sock"], str(Path("x.sock").absolute())),
        (["--control=off"], "off"),
        (["--control=127.0.0.1:0"], "127.0.0.1:0"),
    ],
)
def test_the_unit_file_has_the_control_socket_of_the_command_line_however_it_is_written(
    run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, given: list[str], kept: str
) -> None:
    words = ["gateway", "--systemd-unit", *given, LOOPBACK, "tcp://10.0.0.5"]
    monkeypatch.setattr("sys.argv", ["busway", *words])
    result = run(*words)
    assert result.code == 0
    (start,) = re.findall(r"^ExecStart=(.*)$", result.out, re.MULTILINE)
    assert start.endswith(f"gateway --control {kept} {LOOPBACK} tcp://10.0.0.5")


def test_what_the_policy_of_a_gateway_file_permits_is_asked_like_any_other() -> None:
    file = Path(__file__).parents[1] / "config" / "files" / "gateway.toml"
    with Busway("policy", "test", str(file), "--peer", "10.0.0.7", "--request", "write 4x1 5") as program:
        out, said = program.end()
    assert (program.process.returncode, said) == (0, "")
    assert "allowed" in out
