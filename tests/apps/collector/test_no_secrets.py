"""No password and no token of a collector is in a log, an error, an answer, a repr or a file, whatever its servers do.

1. Every library logs at DEBUG. The servers take the credentials, or send back what they were sent as an error.
2. Searched for are the secrets as they are, quoted for URLs, and in base64.
"""

import base64
import contextlib
import json
import logging
import os
import socketserver
import subprocess
import threading
import traceback
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote
from urllib.request import Request, urlopen

import pytest
from foreign_servers import PostgresqlServer, mosquitto, nats_server, needed
from page_collector import WatchedCollector, watched_collector
from waiting import wait_until
from websockets.sync.client import connect

from busway.apps.collector.configuration import load_collector
from busway.apps.web.access_tokens import read_tokens
from busway.config.files.file_error import FileError

for package in ("aiomqtt", "google.protobuf", "asyncpg", "httpx", "nats"):
    pytest.importorskip(package)

IN_FILES = {"broker": "mqtt-öK%7/x", "scada": "sparkplug-9q7w", "history": "influx-3f8a_z=="}
BUS = {"password": "nats-password-5k2j", "token": "nats-token-7h4g"}


def forms(secret: str) -> set[str]:
    """The ways in which a secret may be written down."""
    raw = [secret.encode(), b"collector:" + secret.encode()]
    return {secret, quote(secret, safe=""), repr(secret)[1:-1], json.dumps(secret)[1:-1]} | {
        base64.b64encode(each).decode() for each in raw
    }


def found_in(text: str, secrets: set[str]) -> list[str]:
    return [form for secret in secrets for form in forms(secret) if form in text]


class Repeating(socketserver.BaseRequestHandler):
    """A server of NATS, MQTT, PostgreSQL or HTTP, whatever fits, that sends back what it gets as an error."""

    def handle(self) -> None:
        with contextlib.suppress(OSError):
            self.request.settimeout(5)
            self.request.sendall(self.server.greeting)  # type: ignore[attr-defined]
            asked = self.request.recv(65536)
            if asked.startswith(b"POST"):
                asked += self.request.recv(65536) if b"\r\n\r\n" not in asked else b""
                head = f"HTTP/1.1 {self.server.status} No\r\nContent-Length: {len(asked)}\r\n\r\n"  # type: ignore[attr-defined]
                self.request.sendall(head.encode() + asked)
            elif asked[:1] == b"\x10":  # CONNECT of MQTT: refused for credentials that are in the reason
                reason = asked.decode("utf-8", "ignore").replace("\x00", "")[-60:].encode()
                properties = b"\x1f" + len(reason).to_bytes(2, "big") + reason
                body = b"\x00\x86" + bytes([len(properties)]) + properties
                self.request.sendall(b"\x20" + bytes([len(body)]) + body)
            elif b"CONNECT {" in asked:
                self.request.sendall(b"-ERR '" + asked.replace(b"\r\n", b" ").replace(b"'", b"") + b"'\r\n")
            else:
                self.request.sendall(b"R\x00\x00\x00\x08\x00\x00\x00\x03")  # of PostgreSQL: the password, please
                text = self.request.recv(65536)[5:].strip(b"\x00")
                fields = b"SFATAL\x00C28000\x00Mno entry for " + text + b"\x00\x00"
                self.request.sendall(b"E" + (len(fields) + 4).to_bytes(4, "big") + fields)


@contextlib.contextmanager
def repeating(greeting: bytes = b"", status: int = 401) -> Iterator[int]:
    """The port of a server that repeats what it is told."""
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Repeating) as server:
        server.daemon_threads = True
        server.greeting, server.status = greeting, status  # type: ignore[attr-defined]
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_address[1]
        server.shutdown()


class Taking(BaseHTTPRequestHandler):
    """Takes lines as InfluxDB does."""

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


def kept(folder: Path, name: str, secret: str) -> str:
    """The path of a file with a secret."""
    file = folder / f"{name}.secret"
    file.write_text(secret + "\n")
    file.chmod(0o600)
    return str(file)


def sinks(folder: Path, ports: dict[str, int], bus: str, database: str, password: str) -> str:
    return f"""
[[sink]]
name = "broker"
url = "mqtt://collector@127.0.0.1:{ports["mqtt"]}"
password_file = "{kept(folder, "broker", IN_FILES["broker"])}"
commands = {{ points = ["pump/level"] }}
age = 0.1
[[sink]]
name = "scada"
url = "sparkplug+mqtt://host@127.0.0.1:{ports["mqtt"]}"
password_variable = "BUSWAY_TEST_SCADA"
group = "plant"
edge_node = "hall"
age = 0.1
[[sink]]
name = "history"
url = "influxdb+http://127.0.0.1:{ports["http"]}/write"
token_file = "{kept(folder, "history", IN_FILES["history"])}"
age = 0.1
[[sink]]
name = "database"
url = "{database}"
password_file = "{kept(folder, "database", password)}"
age = 0.1
[[sink]]
name = "bus"
url = "nats://{"collector@" if bus == "password" else ""}127.0.0.1:{ports["nats"]}"
{bus}_file = "{kept(folder, "bus", BUS[bus])}"
stream = "PLANT"
subject = "plant.{{device}}"
commands = {{ points = ["pump/level"], subject = "commands.{{device}}.{{point}}" }}
age = 0.1
[[sink]]
name = "page"
url = "prometheus://127.0.0.1:0"
points = ["*"]
"""


def answers_of(plant: WatchedCollector, tokens: list[str]) -> Iterator[str]:
    """All that the page, its stream and the page for Prometheus tell, with each token and with a wrong one."""
    base = plant.page.url.rstrip("/")
    with urlopen(f"{base}/openapi.json", timeout=60) as answer:
        document = json.load(answer)
    yield json.dumps(document)
    paths = [path for path, deeds in document["paths"].items() if "get" in deeds]
    assert len(paths) > 8
    for path in ["/", *paths]:
        at = path.replace("{device}", "pump").replace("{point}", "level")
        for token in [*tokens, "", f"wrong-{tokens[0]}"]:
            status, content = raw_answer(base + at, token)
            yield f"{status} {content}"
    for url in plant.collector.pages:
        yield raw_answer(url, "")[1]
    subprotocols = ["busway", f"bearer.{tokens[-1]}"]
    with connect(base.replace("http", "ws") + "/stream", subprotocols=subprotocols, proxy=None) as socket:  # type: ignore[arg-type]
        yield str(socket.recv(timeout=60))


def raw_answer(url: str, token: str) -> tuple[int, str]:
    request = Request(url, headers={"Authorization": f"Bearer {token}"} if token else {})
    try:
        with urlopen(request, timeout=60) as answer:
            return answer.status, answer.read().decode()
    except OSError as error:
        if not hasattr(error, "read"):
            raise
        return 0, error.read().decode()


def told(records: list[logging.LogRecord]) -> str:
    """What is written of log records, with tracebacks, their arguments and all else that they carry."""
    lines = [logging.Formatter("%(name)s %(message)s").format(record) for record in records]
    return "\n".join(lines + [repr(vars(record)) for record in records])


def check(plant: WatchedCollector, folder: Path, secrets: set[str], caplog: pytest.LogCaptureFixture) -> None:
    """Search all that can be searched for the secrets."""
    token_file = folder / "data" / "page-tokens"
    tokens = [line.split()[1] for line in token_file.read_text().splitlines() if line and line[0] != "#"]
    assert len(tokens) == 3
    assert len(read_tokens(token_file)) == 3
    wanted = secrets | set(tokens)
    for name in logging.root.manager.loggerDict:  # also those to which a server has given a level of its own
        caplog.set_level(logging.DEBUG, logger=name)
    for text in answers_of(plant, tokens):
        assert not found_in(text, wanted)
    for sink, options in plant.collector.configuration.sinks.values():
        assert not found_in(f"{sink!r} {sink} {options!r}", wanted)
    for each in (
        plant.collector,
        plant.collector.configuration,
        plant.page,
        *plant.collector.configuration.inputs.values(),
    ):
        assert not found_in(f"{each!r} {each}", wanted)
    for status in (*plant.collector.sink_statuses(), *plant.collector.input_statuses()):
        assert not found_in(repr(status), wanted)
    for record in caplog.records:
        # The viewer of this test; and the words of a server, which its library logs as they came.
        if record.name != "websockets.client" and not str(record.msg).startswith("Received CONNACK"):
            assert not found_in(told([record]), wanted)
    files = [path for path in (folder / "data").rglob("*") if path.is_file() and path != token_file]
    for path in files:
        content = path.read_bytes()
        assert not [form for secret in wanted for form in forms(secret) if form.encode() in content], path


@pytest.fixture
def all_told(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.DEBUG)
    for name in logging.root.manager.loggerDict:
        caplog.set_level(logging.DEBUG, logger=name)
    monkeypatch.setenv("BUSWAY_TEST_SCADA", IN_FILES["scada"])
    return caplog


@pytest.mark.parametrize(("bus", "status"), [("password", 401), ("token", 400)])
def test_servers_that_repeat_what_they_are_told(
    bus: str, status: int, tmp_path: Path, all_told: pytest.LogCaptureFixture
) -> None:
    password = "database-6t3r"
    info = b'INFO {"server_id":"x","version":"2.9.0","max_payload":1048576,"proto":1,"auth_required":true}\r\n'
    with repeating(info) as nats, repeating(b"", status) as other:
        ports = {"mqtt": other, "http": other, "nats": nats}
        database = f"postgresql://collector@127.0.0.1:{other}/plant?sslmode=disable"
        more = sinks(tmp_path, ports, bus, database, password)
        with watched_collector(tmp_path, more=more) as plant:

            def has_failed() -> bool:
                errors = {each.name: each.error for each in plant.collector.sink_statuses() if each.error}
                inputs = [each.error for each in plant.collector.input_statuses()]
                return errors.keys() >= {"broker", "scada", "history", "database", "bus"} and all(inputs)

            wait_until(has_failed)
            check(plant, tmp_path, {*IN_FILES.values(), password, BUS[bus]}, all_told)


@pytest.mark.real_time
def test_servers_that_take_the_credentials(tmp_path: Path, all_told: pytest.LogCaptureFixture) -> None:
    users = tmp_path / "users"
    for name, key in (("collector", "broker"), ("host", "scada")):
        words = [needed("mosquitto_passwd"), "-b", *([] if users.exists() else ["-c"]), str(users), name, IN_FILES[key]]
        subprocess.run(words, check=True, timeout=60, capture_output=True)
    users.chmod(0o644)
    lines = ["allow_anonymous false", f"password_file {users}", *(["user root"] if os.geteuid() == 0 else [])]
    authorization = f'authorization {{ user: collector, password: "{BUS["password"]}" }}'
    web = ThreadingHTTPServer(("127.0.0.1", 0), Taking)
    threading.Thread(target=web.serve_forever, daemon=True).start()
    with (
        contextlib.ExitStack() as servers,
        mosquitto(tmp_path, *lines) as broker,
        nats_server(tmp_path, authorization) as nats,
        PostgresqlServer() as database,
    ):
        servers.callback(web.server_close)
        servers.callback(web.shutdown)
        ports = {"mqtt": broker.port, "http": web.server_port, "nats": nats.port}
        more = sinks(tmp_path, ports, "password", database.url, database.PASSWORD)
        with watched_collector(tmp_path, more=more) as plant:

            def has_sent() -> bool:
                return all(each.sent for each in plant.collector.sink_statuses())

            wait_until(has_sent)
            wait_until(lambda: not any(each.error for each in plant.collector.input_statuses()))
            assert not [each.error for each in plant.collector.sink_statuses() if each.error]
            check(plant, tmp_path, {*IN_FILES.values(), database.PASSWORD, BUS["password"]}, all_told)


@pytest.mark.parametrize(
    "line",
    [
        'url = "mqtt://collector:hunter2-secret@broker"',
        'url = "postgresql://db/plant?password=hunter2-secret"',
        'url = "nats://:hunter2-secret@bus"',
        'url = "mqtt://broker"\npassword = "hunter2-secret"',
        'url = "influxdb+http://host/write"\ntoken = "hunter2-secret"',
        'url = "mqtt://collector:hunter2-secret@broker:port"',
    ],
)
def test_a_secret_in_the_wrong_place_is_refused_and_not_repeated(line: str, tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(f'[collector]\nstore = "data"\n[[sink]]\nname = "s"\n{line}\n')
    with pytest.raises(FileError) as caught:
        load_collector(file)
    assert "hunter2" not in "".join(traceback.format_exception(caught.value))
    assert "hunter2" not in repr(caught.value)
