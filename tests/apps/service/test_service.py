"""A server with all around it: what is read-only for want of a policy, what is undone where it cannot start."""

import asyncio
import gc
import socket
import threading
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from waiting import until

import busway
from busway.apps.service.configuration import Configuration, load_configuration, parse_configuration
from busway.apps.service.overrides import Overrides
from busway.apps.service.service import Service
from busway.framing.mbap import encode_mbap
from busway.testing import CertificateStore

UNIT = "[[unit]]\nunit = 1\nholding_registers = 10\n"


def configured(listen: str, rest: str = "") -> Configuration:
    return parse_configuration(f'listen = ["{listen}"]\n{rest}{UNIT}', "x.toml")


async def test_what_was_opened_before_is_closed_where_the_rest_cannot_be_had(tmp_path: Path) -> None:
    busy = busway.serve("tcp://127.0.0.1:0", units={1: busway.Device()})
    async with busy:
        service = Service(
            lambda: configured(busy.endpoints[0]), Overrides(audit=str(tmp_path / "a.jsonl"), control="off")
        )
        with pytest.raises(busway.LinkDown, match="the port is taken"):
            async with service:
                pass
        assert not service.server.is_running


async def test_the_control_socket_answers_where_it_is_wanted_and_reads_files_again() -> None:
    text = ["read-only"]
    overrides = Overrides(control="127.0.0.1:0", can_reload=True)

    def read() -> Configuration:
        return configured("tcp://127.0.0.1:0", f'[policy]\ndefault = "{text[0]}"\n')

    async with Service(read, overrides) as service:
        assert await service.reload() == ["nothing has changed"]
        text[0] = "allow"
        assert await service.reload() == ["the policy was replaced"]
        assert await service.reload() == ["nothing has changed"]
        async with busway.open(service.server.endpoints[0], shared=False) as link:
            await link.unit(1).write_single_register(0, 1)
        text[0] = "no list"
        with pytest.raises(busway.ConfigError):
            await service.reload()
        async with busway.open(service.server.endpoints[0], shared=False) as link:
            await link.unit(1).write_single_register(0, 2)


async def test_a_policy_that_is_no_longer_written_leaves_network_listeners_read_only() -> None:
    rest = ['[policy]\ndefault = "allow"\n']
    overrides = Overrides(control="off", can_reload=True, standard_port=False)
    async with Service(lambda: configured("tcp://0.0.0.0:0", rest[0]), overrides) as service:
        assert service.read_only == ()
        rest[0] = ""
        assert await service.reload() == ["the policy was replaced"]
        assert service.read_only == tuple(service.server.endpoints)
        url = service.server.endpoints[0].replace("0.0.0.0", "127.0.0.1")
        async with busway.open(url, shared=False) as link:
            with pytest.raises(busway.ExceptionReply, match="exception 01"):
                await link.unit(1).write_single_register(0, 1)


async def test_certificates_are_read_again_at_once_and_what_cannot_be_used_is_told(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    names = [store.server("first")]

    def read() -> Configuration:
        text = "".join(f"{key} = '{value}'\n" for key, value in names[0].options().items())
        return configured("tls://127.0.0.1:0", f"[security]\n{text}")

    async with Service(read, Overrides(control="off", can_reload=True)) as service:

        def subject() -> str:
            (listener,) = service.server.status().listeners
            return str(listener.security.subject)

        assert subject() == "CN=first"
        first = names[0]
        store.authority.server(["localhost"], name="renewed").write(first.certificate, first.key)
        assert await service.reload() == ["certificates hold from the next connection on"]
        assert subject() == "CN=renewed"
        names[0] = store.server("second")
        first.certificate.unlink()
        told = "; ".join(await service.reload())
        assert "certificates stay as they were" in told
        assert "first.pem" in told
        assert "only the next start will see security" in told
        assert subject() == "CN=renewed"


WRITE = encode_mbap(7, 1, bytes.fromhex("06 0000 0005"))


class Denying:
    """A file whose list of denied hosts changes."""

    def __init__(self, listen: str, rest: str = "") -> None:
        self.denied = "192.0.2.1"
        self._listen = listen
        self._rest = rest

    def __call__(self) -> Configuration:
        policy = f'[policy]\ndefault = "allow"\ndeny = ["{self.denied}"]\n'
        return configured(self._listen, f"{self._rest}{policy}")


def from_host(host: str, service: Service, kind: socket.SocketKind) -> socket.socket:
    """A socket of a client with an address of its own."""
    made = socket.socket(socket.AF_INET, kind)
    made.settimeout(10)
    made.bind((host, 0))
    parts = urlsplit(service.server.endpoints[0])
    made.connect((parts.hostname, parts.port))
    return made


async def asked(client: socket.socket) -> bytes:
    """What a client gets for a write; empty where its connection has ended."""
    try:
        client.send(WRITE)
        return await asyncio.to_thread(client.recv, 300)
    except ConnectionError:
        return b""


async def test_a_reload_ends_connections_of_hosts_that_are_now_denied_and_no_others() -> None:
    read = Denying("tcp://127.0.0.1:0")
    async with Service(read, Overrides(control="off", can_reload=True)) as service:
        with (
            from_host("127.0.0.1", service, socket.SOCK_STREAM) as denied,
            from_host("127.0.0.2", service, socket.SOCK_STREAM) as other,
        ):
            assert (await asked(denied), await asked(other)) == (WRITE, WRITE)
            read.denied = "127.0.0.1"
            assert await service.reload() == [
                "the policy was replaced",
                "connections of hosts that may no longer connect were ended: 1",
            ]
            assert (await asked(denied), await asked(other)) == (b"", WRITE)
            status = service.server.status()
            assert [each.peer.partition(":")[0] for each in status.connections] == ["127.0.0.2"]
            assert status.counters.no_longer_authorized == 1
            assert await service.reload() == ["nothing has changed"]


async def test_a_reload_ends_the_conversation_of_a_udp_peer_that_is_now_denied() -> None:
    read = Denying("udp://127.0.0.1:0")
    async with Service(read, Overrides(control="off", can_reload=True)) as service:
        with (
            from_host("127.0.0.1", service, socket.SOCK_DGRAM) as denied,
            from_host("127.0.0.2", service, socket.SOCK_DGRAM) as other,
        ):
            assert (await asked(denied), await asked(other)) == (WRITE, WRITE)
            read.denied = "127.0.0.1"
            assert "connections of hosts that may no longer connect were ended: 1" in await service.reload()
            denied.send(WRITE)
            assert await asked(other) == WRITE
            await until(lambda: service.server.status().counters.unauthorized == 1)
            assert [each.peer.partition(":")[0] for each in service.server.status().connections] == ["127.0.0.2"]


async def test_a_reload_ends_tls_connections_and_handshakes_of_hosts_that_are_now_denied(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    text = "".join(f"{key} = '{value}'\n" for key, value in store.server().options().items())
    read = Denying("tls://127.0.0.1:0", f"[security]\n{text}")
    async with Service(read, Overrides(control="off", can_reload=True)) as service:
        url = f"{service.server.endpoints[0]}?{store.client().query()}"
        async with busway.open(url, shared=False, retries=0) as link:
            await link.unit(1).write_single_register(0, 1)
            with from_host("127.0.0.1", service, socket.SOCK_STREAM) as silent:
                await until(lambda: service.server.status().listeners[0].security.handshakes == 1)
                read.denied = "127.0.0.0/8"
                assert "connections of hosts that may no longer connect were ended: 2" in await service.reload()
                assert await asked(silent) == b""
            with pytest.raises((busway.LinkDown, busway.NoReply, busway.WriteOutcomeUnknown)):
                await link.unit(1).write_single_register(0, 2)
            assert service.server.status().connections == ()


async def test_requests_are_answered_while_a_file_is_read_again_and_the_policy_changes_in_one_step() -> None:
    """Judged by what happens while the file is being read, not by the clock."""
    is_read, may_go_on = threading.Event(), threading.Event()
    text = ["allow"]

    def read() -> Configuration:
        made = configured("tcp://127.0.0.1:0", f'[policy]\ndefault = "{text[0]}"\n')
        if text[0] == "deny":
            is_read.set()
            assert may_go_on.wait(30)
        return made

    async with (
        Service(read, Overrides(control="off", can_reload=True)) as service,
        busway.open(service.server.endpoints[0], shared=False) as link,
    ):
        text[0] = "deny"
        reload = asyncio.create_task(service.reload())
        await until(is_read.is_set)
        for value in range(20):
            await link.unit(1).write_single_register(0, value)
        assert not reload.done()
        may_go_on.set()
        assert await reload == ["the policy was replaced"]
        with pytest.raises(busway.ExceptionReply, match="exception 01"):
            await link.unit(1).write_single_register(0, 1)


def rules(count: int, more: str = "") -> str:
    """A policy of many rules, each for a host of its own."""
    made = "".join(
        f'[[policy.rule]]\npeers = ["10.0.{n >> 8}.{n & 255}"]\naddresses = "4x1-4x{n % 100 + 2}"\n'
        for n in range(count)
    )
    return f'[policy]\ndefault = "allow"\n{more}{made}'


async def test_the_event_loop_turns_while_thousands_of_rules_are_read() -> None:
    text = [rules(1)]
    async with Service(
        lambda: configured("tcp://127.0.0.1:0", text[0]), Overrides(control="off", can_reload=True)
    ) as service:
        text[0] = rules(3000)
        reload = asyncio.create_task(service.reload())
        turns = 0
        while not reload.done():
            await asyncio.sleep(0.001)
            turns += 1
        assert await reload == ["the policy was replaced"]
        assert turns > 20  # it takes half a second and more; read in the loop it is 1
        assert gc.isenabled()


def test_more_rules_than_there_may_be_are_refused_before_they_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.config.files.policy.MOST_RULES", 3)
    configured("tcp://127.0.0.1:0", rules(3))
    with pytest.raises(busway.ConfigError, match="there are 4 rules, and 3 are the limit"):
        configured("tcp://127.0.0.1:0", rules(4))


def test_a_file_larger_than_it_may_be_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.config.file_text.MOST_BYTES", 2048)
    file = tmp_path / "plant.toml"
    text = f'listen = ["tcp://127.0.0.1:0"]\n{UNIT}#'.encode()
    file.write_bytes(text.ljust(2048, b"#"))
    load_configuration(file)
    file.write_bytes(text.ljust(2049, b"#"))
    with pytest.raises(busway.ConfigError, match="is larger than 2 KiB, the limit for such a file"):
        load_configuration(file)
