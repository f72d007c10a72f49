"""Foreign clients on foreign servers: what fails with ours and passes here is no fault of the line or of the peers."""

from collections.abc import Iterator

import foreign
import pytest
from serial_peers import CLIENTS, SERVERS, new_line, start_client, start_server

PAIRS = [(client, server) for client in CLIENTS for server in SERVERS if client.split("-")[1] == server.split("-")[1]]


@pytest.fixture(params=PAIRS, scope="module", ids=lambda pair: f"{pair[0]}_on_{pair[1]}")
def client(request: pytest.FixtureRequest) -> Iterator[foreign.Program]:
    kind, server = request.param
    with new_line() as line, start_server(server, line.paths[1]), start_client(kind, line.paths[0]) as program:
        yield program


@pytest.mark.parametrize("table", foreign.CONTENT)
def test_reading_a_table_gives_its_content(client: foreign.Program, table: str) -> None:
    answer = client.ask(f"read_{table} 17 100")
    assert answer == {"ok": True, "values": foreign.CONTENT[table][17:117]}


def test_what_was_written_is_read(client: foreign.Program) -> None:
    assert client.ask("write_multiple_registers 500 1 2 40000")["ok"]
    assert client.ask("read_holding_registers 500 3")["values"] == [1, 2, 40000]
