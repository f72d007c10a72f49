"""Servers that a walk's collector sends to, and what each of them has to show for it at the end.

1. A receiver is down and back as often as a test wants; what it took before stays with it.
2. It is judged by what the file of lines got: the same samples with the same values, none missing, in the order of
   their commits and times for each point. A repetition is an equal copy, and only where the receiver may have one.
"""

import asyncio
import importlib.util
import json
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Protocol

from foreign_servers import ForeignServer, PostgresqlServer, durable_mosquitto, nats_server, needed
from kept_once import Delivered, Key
from missing_peers import installed


class Receiver(Protocol):
    """A server that takes samples.

    Attributes:
        name: of the sink that sends to it.
        server: what is stopped and started.
        section: the text of its ``[[sink]]``.
    """

    name: str
    server: ForeignServer
    section: str

    def problems(self, lines: Delivered) -> Iterable[str]:
        """What it has that is not in the lines, or twice, or in another order, or not at all."""


class NatsReceiver:
    """A stream: it has each message once."""

    def __init__(self, server: ForeignServer) -> None:
        self.name, self.server = "bus", server
        self.section = (
            f'[[sink]]\nname = "bus"\nurl = "nats://127.0.0.1:{server.port}"\nage = 0.1\n'
            'subject = "plant.{device}"\nstream = "PLANT"\n'
        )

    def problems(self, lines: Delivered) -> Iterable[str]:
        return document_problems("the stream", asyncio.run(self._messages()), lines, once=True)

    async def _messages(self) -> list[dict[str, Any]]:
        import nats

        client = await nats.connect(f"nats://127.0.0.1:{self.server.port}")
        try:
            stream = client.jetstream()
            count = (await stream.stream_info("PLANT")).state.messages
            found: list[dict[str, Any]] = []
            subscription = await stream.subscribe("plant.>", stream="PLANT", ordered_consumer=True)
            for _ in range(count):
                message = await subscription.next_msg(10)
                found.append(json.loads(message.data))
            return found
        finally:
            await client.close()


class MqttReceiver:
    """A broker that keeps what it takes for a subscriber who is away until the end."""

    SUBSCRIBER = ("-V", "mqttv5", "-q", "1", "-c", "-x", "4294967295", "-i", "checker")
    END = "the-end"

    def __init__(self, server: ForeignServer) -> None:
        self.name, self.server = "broker", server
        self.section = (
            f'[[sink]]\nname = "broker"\nurl = "mqtt://127.0.0.1:{server.port}"\nage = 0.1\n'
            'topic = "plant/{device}"\n'
        )
        self._where = ("-h", "127.0.0.1", "-p", str(server.port))
        self._run("mosquitto_sub", *self.SUBSCRIBER, "-t", "#", "-E")

    def _run(self, program: str, *arguments: str) -> str:
        command = [needed(program), *self._where, *arguments]
        return subprocess.run(command, check=True, timeout=60, capture_output=True, text=True).stdout

    def problems(self, lines: Delivered) -> Iterable[str]:
        return document_problems("the broker", self._messages(), lines, once=False)

    def _messages(self) -> Iterator[dict[str, Any]]:
        self._run("mosquitto_pub", "-V", "mqttv5", "-q", "1", "-t", self.END, "-m", "-")
        command = [needed("mosquitto_sub"), *self._where, *self.SUBSCRIBER, "-t", "#", "-F", "%t\t%p", "-W", "60"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                topic, _, payload = line.rstrip("\n").partition("\t")
                if topic == self.END:
                    process.kill()  # a subscriber can block in its handler of SIGTERM
                    return
                if not topic.endswith("/status"):
                    yield json.loads(payload)
        raise AssertionError("the broker did not say all that it kept")


class PostgresqlReceiver:
    """A table: it has each sample once."""

    def __init__(self, server: PostgresqlServer, folder: Path) -> None:
        self.name = "database"
        self.server: ForeignServer = server
        self._url, self._password = server.url, server.PASSWORD
        secret = folder / "password"
        secret.write_text(server.PASSWORD)
        secret.chmod(0o600)
        self.section = (
            f'[[sink]]\nname = "database"\nurl = "{server.url}"\nage = 0.1\n'
            f'password_file = "{secret}"\ntable = "outage"\n'
        )

    def problems(self, lines: Delivered) -> Iterable[str]:
        found = asyncio.run(self._rows())
        wanted = values_of(lines)
        for key, value in found.items():
            if key not in wanted or float(wanted[key]) != value:
                yield f"{key} is {value} in the database and {wanted.get(key)} in the file"
        for key in wanted.keys() - found.keys():
            yield f"{key} never reached the database"

    async def _rows(self) -> dict[Key, float]:
        import asyncpg

        connection = await asyncpg.connect(self._url, password=self._password)
        try:
            rows = await connection.fetch(
                "SELECT device, point, (extract(epoch FROM time) * 1000000)::bigint * 1000 + nanoseconds AS time, value"
                " FROM outage WHERE value IS NOT NULL"
            )
        finally:
            await connection.close()
        return {(row["device"], row["point"], row["time"]): row["value"] for row in rows}


def values_of(lines: Delivered) -> dict[Key, Any]:
    """The samples with values that the file got."""
    return {key: value for key, values in lines.values.items() for value in values if value is not None}


def document_problems(where: str, found: Iterable[Mapping[str, Any]], lines: Delivered, *, once: bool) -> Iterator[str]:
    """What documents have twice, otherwise than the file, out of order, or not at all."""
    known: dict[str, Mapping[str, Any]] = {}
    samples: set[Key] = set()
    last: dict[tuple[str, str], tuple[int, int]] = {}
    wanted = values_of(lines)
    for document in found:
        key = document["key"]
        if key in known:
            if once or known[key] != document:
                yield f"{key} is in {where} twice: {known[key]} and {document}"
            continue
        known[key] = document
        commit = int(key.partition("-")[0])
        for read in document["reads"]:
            for point, value in read["values"].items():
                sample = (document["device"], point, read["time"])
                if sample in samples:
                    yield f"{sample} is in two documents of {where}"
                samples.add(sample)
                if wanted.get(sample) != value:
                    yield f"{sample} is {value} in {where} and {wanted.get(sample)} in the file"
                place = (commit, read["time"])
                if place <= last.get(sample[:2], (0, 0)):
                    yield f"{sample} of commit {commit} came to {where} after {last[sample[:2]]}"
                last[sample[:2]] = place
    for sample in wanted.keys() - samples:
        yield f"{sample} never reached {where}"


def is_there(package: str, program: str) -> bool:
    """Whether a server and the package for it are installed."""
    return importlib.util.find_spec(package) is not None and installed(program) is not None


@contextmanager
def receivers_that_are_there(folder: Path, *, database: bool = False) -> Iterator[list[Receiver]]:
    """A stream, a broker and, if it is wanted, a database: those whose programs are installed."""
    with ExitStack() as servers:
        found: list[Receiver] = []
        if is_there("nats", "nats-server"):
            found.append(NatsReceiver(servers.enter_context(nats_server(folder))))
        if is_there("aiomqtt", "mosquitto") and is_there("aiomqtt", "mosquitto_sub"):
            found.append(MqttReceiver(servers.enter_context(durable_mosquitto(folder))))
        if database and importlib.util.find_spec("asyncpg") is not None:
            server = PostgresqlServer()
            servers.enter_context(server)
            found.append(PostgresqlReceiver(server, folder))
        yield found
