"""Modbus/TCP Security between pymodbus and us, either side being the server, with certificates on both."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import foreign
import pytest

import busway
from busway.testing.certificates import CertificateFiles, CertificateStore

UNIT = 1
READS = ("read_coils", "read_discrete_inputs", "read_holding_registers", "read_input_registers")
TABLES = ("coils", "discrete_inputs", "holding_registers", "input_registers")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> CertificateStore:
    return CertificateStore(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def server_files(store: CertificateStore) -> CertificateFiles:
    return store.server()


@pytest.fixture(scope="module")
def client_files(store: CertificateStore) -> CertificateFiles:
    return store.client("pymodbus", role="Operator")


def paths(files: CertificateFiles) -> tuple[Path, Path, Path]:
    return files.certificate, files.key, files.authority


# --- our client, their server -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def their_server(server_files: CertificateFiles) -> Iterator[foreign.Program]:
    with foreign.python_peer("pymodbus_server.py", "tls", 0, *paths(server_files)) as program:
        yield program


@pytest.fixture
def unit(their_server: foreign.Program, client_files: CertificateFiles, unit_at: Callable[[str], Any]) -> Any:
    return unit_at(f"tls://localhost:{their_server.ready}?{client_files.query()}")


@pytest.mark.clause("M1")
@pytest.mark.parametrize(("method", "table"), list(zip(READS, TABLES, strict=True)))
def test_our_client_reads_every_table_of_their_server(unit: Any, method: str, table: str) -> None:
    assert getattr(unit, method)(10, count=50) == foreign.CONTENT[table][10:60]


@pytest.mark.clause("M1")
def test_our_client_writes_to_their_server(unit: Any) -> None:
    unit.write_multiple_registers(900, [1, 2, 3])
    assert unit.read_holding_registers(900, count=3) == [1, 2, 3]
    with pytest.raises(busway.ExceptionReply):
        unit.read_holding_registers(65_000, count=1)


@pytest.mark.clause("M3")
def test_their_server_drops_a_foreign_certificate_without_an_alert_and_we_say_what_that_may_mean(
    their_server: foreign.Program, store: CertificateStore
) -> None:
    stranger = store.client("stranger", authority=store.foreign)
    with (
        busway.connect(f"tls://localhost:{their_server.ready}?{stranger.query()}") as link,
        pytest.raises(busway.LinkDown, match="closed the connection without a word: it may not accept our certificate"),
    ):
        link.unit(UNIT).read_holding_registers(0, count=1)


# --- our server, their client -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def our_server(server_files: CertificateFiles) -> Iterator[Any]:
    device = busway.Device(**foreign.CONTENT)
    url = f"tls://127.0.0.1:0?{server_files.query()}&require_role=on"
    with busway.serve_in_thread(url, units={UNIT: device}) as server:
        yield server


@pytest.fixture(scope="module")
def their_client(our_server: Any, client_files: CertificateFiles) -> Iterator[foreign.Program]:
    port = our_server.endpoints[0].rpartition(":")[2]
    with foreign.python_peer("pymodbus_client.py", "tls", "127.0.0.1", port, UNIT, *paths(client_files)) as program:
        yield program


@pytest.mark.clause("M1")
@pytest.mark.parametrize(("method", "table"), list(zip(READS, TABLES, strict=True)))
def test_their_client_reads_every_table_of_our_server(their_client: foreign.Program, method: str, table: str) -> None:
    assert their_client.ask(f"{method} 10 50")["values"] == foreign.CONTENT[table][10:60]


@pytest.mark.clause("M5")
def test_their_client_has_its_role_and_writes(their_client: foreign.Program, our_server: Any) -> None:
    their_client.ask("write_multiple_registers 900 7 8 9")
    assert their_client.ask("read_holding_registers 900 3")["values"] == [7, 8, 9]
    (connection,) = our_server.status().connections
    assert (connection.role, connection.subject) == ("Operator", "CN=pymodbus")
