"""Roles and rights over real TLS: the table belongs to the user, and is asked at every request."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from tls_peers import READ, VERSIONS, ask, foreign_client, foreign_context

import busway
from busway import AuditLog, Policy, Rule
from busway.options.tls import TlsVersion
from busway.server.serving import ServerThread
from busway.testing.certificates import CertificateStore

WRITE = bytes.fromhex("0002 0000 0006 01 06 0000 0007")
READ_REPLY = bytes.fromhex("0001 0000 0005 01 03 02 04D2")
READ_DENIED = bytes.fromhex("0001 0000 0003 01 83 01")
WRITE_DENIED = bytes.fromhex("0002 0000 0003 01 86 01")

RIGHTS = Policy.of(
    Rule.of(name="operators", roles=["Operator"]),
    Rule.of(name="viewers", roles=["Viewer"], action="read-only"),
    default="deny",
)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> CertificateStore:
    return CertificateStore(tmp_path_factory.mktemp("certificates"))


@pytest.fixture
def device() -> busway.Device:
    return busway.Device(holding_registers=[1234, 0])


@pytest.fixture
def served(store: CertificateStore, device: busway.Device) -> Iterator[ServerThread]:
    with busway.serve_in_thread(f"tls://127.0.0.1:0?{store.server().query()}", units=device, policy=RIGHTS) as server:
        yield server


def port_of(server: ServerThread) -> int:
    return int(server.endpoints[0].rpartition(":")[2])


@pytest.mark.clause("M6")
@pytest.mark.parametrize(
    ("role", "reads", "writes"),
    [
        ("Operator", READ_REPLY, WRITE),
        ("Viewer", READ_REPLY, WRITE_DENIED),
        ("operator", READ_DENIED, WRITE_DENIED),  # another role: the whole string counts, letter by letter
        ("Operator,Viewer", READ_DENIED, WRITE_DENIED),
        (None, READ_DENIED, WRITE_DENIED),
    ],
)
def test_a_role_has_the_rights_that_the_policy_gives_it_and_no_others(
    store: CertificateStore,
    served: ServerThread,
    device: busway.Device,
    role: str | None,
    reads: bytes,
    writes: bytes,
) -> None:
    files = store.client("someone", role=role)
    with foreign_client(port_of(served), foreign_context(files, files)) as client:
        for _ in range(3):  # at every request, not only at the first
            assert ask(client, READ) == reads
            device.holding_registers[0] = 1234
            assert ask(client, WRITE) == writes
            assert device.holding_registers[0] == (7 if writes == WRITE else 1234)
            device.holding_registers[0] = 1234


@pytest.mark.clause("M4")
@pytest.mark.clause("M6")
@pytest.mark.parametrize("version", VERSIONS)
def test_a_resumed_session_has_the_rights_of_its_role(
    store: CertificateStore, served: ServerThread, version: TlsVersion
) -> None:
    files = store.client("viewer", role="Viewer")
    context = foreign_context(files, files, version)
    with foreign_client(port_of(served), context) as client:
        assert ask(client, READ) == READ_REPLY
        session = client.session
        client.unwrap()
    with foreign_client(port_of(served), context, session) as client:
        assert client.session_reused
        assert ask(client, READ) == READ_REPLY
        assert ask(client, WRITE) == WRITE_DENIED


@pytest.mark.clause("M6")
def test_the_audit_log_names_the_role(store: CertificateStore, tmp_path: Path) -> None:
    files = store.client("viewer", role="Viewer")
    audit = AuditLog(tmp_path / "audit.jsonl")
    url = f"tls://127.0.0.1:0?{store.server().query()}"
    with (
        busway.serve_in_thread(url, units=busway.Device(holding_registers=1), policy=RIGHTS, audit=audit) as server,
        foreign_client(port_of(server), foreign_context(files, files)) as client,
    ):
        assert ask(client, WRITE) == WRITE_DENIED
    audit.close()
    (line,) = (tmp_path / "audit.jsonl").read_text().splitlines()
    entry = json.loads(line)
    assert entry["role"] == "Viewer"
    assert entry["rule"] == "viewers"
