"""Half-open connections, as Messaging on TCP/IP V1.0b §4.2.2 tells them case by case, between hosts of their own.

1. Keepalive and user timeout are short here, so that a case takes seconds; their defaults are tested elsewhere.
2. No case may cost a place: what the server has in the end is looked at each time.
"""

import json
from pathlib import Path
from typing import Any

import pytest
from hosts import Host, Network
from told_program import Program

PROGRAMS = Path(__file__).parent / "programs"
PORT = 5020
SLOW = 1000
"""From this address on the server answers when it is told to."""

SHORT = {"keepalive_idle": 1, "keepalive_interval": 1, "keepalive_count": 2}
KEEPALIVE = 3.0
"""Seconds until these find a peer that has gone: idle + interval × count."""
LATE = 2.0
"""Seconds that a loaded machine may add."""
NEVER = {"keepalive": False, "user_timeout": None}
"""The system finds out nothing within the time of a test."""
SOON = 2.0
"""Seconds after which something that needs no timer of TCP must have happened, on a loaded machine too."""

both_kinds = pytest.mark.parametrize("via", ["asyncio", "blocking"])
pytestmark = pytest.mark.clause("T18")


def _server(host: Host, **options: Any) -> Program:
    return host.start(PROGRAMS / "server.py", f"tcp://{host.address}:{PORT}", json.dumps(options))


def _client(host: Host, via: str, server: Host, **options: Any) -> Program:
    client = host.start(PROGRAMS / "client.py", via, f"tcp://{server.address}:{PORT}", json.dumps(options))
    server.ready()
    return client


def _fixed(host: Host, server: Host, own_port: int) -> Program:
    client = host.start(PROGRAMS / "fixed_port.py", server.address, str(PORT), str(own_port))
    server.ready()
    return client


def _reads(client: Program, address: int = 5, **call: Any) -> dict[str, Any]:
    """A read that must succeed."""
    answer = client.ask("read", address=address, **call)
    assert answer.get("value") == [address], answer
    return answer


# --- §4.2.2.1: the cable is cut ------------------------------------------------------------


@both_kinds
def test_cut_of_an_idle_connection_that_is_shorter_than_keepalive_is_not_noticed(network: Network, via: str) -> None:
    here, there = network.host(), network.host()
    server, client = _server(there), _client(here, via, there)
    _reads(client)
    there.cut()
    assert server.ask("until", connections=0, seconds=0.5)["connections"]
    there.mend()
    _reads(client, timeout=5)
    status = server.ask("status")
    assert (status["accepted"], status["closed"], len(status["connections"])) == (1, 0, 1)


@both_kinds
@pytest.mark.clause("T19")
def test_cut_of_an_idle_connection_that_is_longer_than_keepalive_is_found_at_both_ends(
    network: Network, via: str
) -> None:
    here, there = network.host(), network.host()
    server, client = _server(there, **SHORT), _client(here, via, there, **SHORT)
    _reads(client)
    there.cut()
    assert client.until_established(PORT, 0, KEEPALIVE + LATE) > KEEPALIVE / 2
    gone = server.ask("until", connections=0, seconds=KEEPALIVE + LATE)
    assert (gone["connections"], gone["closed"]) == ([], 1)
    there.mend()
    _reads(client)  # the end of an idle connection is nothing that a caller hears of
    assert server.ask("status")["accepted"] == 2
    assert len(server.ask("status")["connections"]) == 1


@both_kinds
def test_short_cut_within_a_transaction_is_bridged_by_retransmission(network: Network, via: str) -> None:
    here, there = network.host(), network.host()
    server, client = _server(there), _client(here, via, there, timeout=10, retries=0)
    client.tell("read", address=SLOW)
    assert server.ask("until", waiting=1, seconds=10)["waiting"] == 1
    here.cut()
    server.ask("go_on")
    assert server.ask("until", waiting=0, seconds=10)["waiting"] == 0  # the reply left, and is lost on the way
    here.mend()
    assert client.outcome()["value"] == [SLOW]
    status = server.ask("status")
    assert (status["accepted"], status["requests"]) == (1, 1)


@both_kinds
@pytest.mark.clause("T37")
@pytest.mark.parametrize(("do", "error"), [("read", "NoReply"), ("write", "WriteOutcomeUnknown")])
def test_request_into_a_cut_cable_ends_with_a_reason_when_its_time_is_over(
    network: Network, via: str, do: str, error: str
) -> None:
    here, there = network.host(), network.host()
    server = _server(there, **SHORT)
    client = _client(here, via, there, timeout=0.5, retries=0)
    _reads(client)
    there.cut()
    answer = client.ask(do, address=6)
    assert answer["error"] == error, answer
    assert answer["seconds"] < 0.5 + SOON
    there.mend()
    _reads(client, timeout=10)
    assert len(server.ask("until", connections=1, seconds=KEEPALIVE + LATE)["connections"]) == 1


@both_kinds
@pytest.mark.clause("T19", "T37")
@pytest.mark.parametrize(
    ("do", "error", "cause"), [("read", "LinkDown", ""), ("write", "WriteOutcomeUnknown", "LinkDown")]
)
def test_user_timeout_ends_a_connection_that_takes_no_request_before_the_reply_is_due(
    network: Network, via: str, do: str, error: str, cause: str
) -> None:
    here, there = network.host(), network.host()
    _server(there)
    client = _client(here, via, there, timeout=20, retries=0, user_timeout=1.0)
    _reads(client)
    there.cut()
    answer = client.ask(do, address=6)
    assert answer["error"] == error, answer
    assert cause in answer["cause"]
    assert 0.5 < answer["seconds"] < 1.0 + LATE
    assert client.established(PORT) == 0


@both_kinds
@pytest.mark.clause("T19", "T37")
def test_user_timeout_ends_a_connection_that_takes_no_reply_and_its_place_is_free(network: Network, via: str) -> None:
    here, there = network.host(), network.host()
    server = _server(there, user_timeout=1.0, keepalive=False, max_transactions=1, scope="server")
    client = _client(here, via, there, timeout=0.5, retries=0, **NEVER)
    client.tell("read", address=SLOW)
    assert server.ask("until", waiting=1, seconds=10)["waiting"] == 1
    here.cut()
    server.ask("go_on")
    gone = server.ask("until", connections=0, seconds=1.0 + LATE)
    assert gone["connections"] == []
    assert 0.5 < gone["seconds"] < 1.0 + LATE
    assert client.outcome()["error"] == "NoReply"
    here.mend()
    _reads(client, SLOW, timeout=10, retries=3)  # with the server's only slot for a slow request


# --- §4.2.2.2: the server crashes, or is started again ------------------------------------------------------------


@both_kinds
@pytest.mark.parametrize("do", ["read", "write"])
def test_server_that_was_killed_and_started_again_is_asked_as_if_nothing_had_been(
    network: Network, via: str, do: str
) -> None:
    here, there = network.host(), network.host()
    server, client = _server(there), _client(here, via, there, retries=0)
    _reads(client)
    server.kill()
    client.until_established(PORT, 0, SOON)
    server = _server(there)
    server.ready()
    answer = client.ask(do, address=6)
    assert "value" in answer, answer
    assert answer["seconds"] < SOON
    assert server.ask("status")["accepted"] == 1


@both_kinds
def test_read_that_a_returned_server_resets_is_asked_again_at_once(network: Network, via: str) -> None:
    here, there = network.host(), network.host()
    _server(there)
    client = _client(here, via, there, timeout=10)
    _reads(client)
    there.crash()
    there.boot()
    server = _server(there)
    server.ready()
    assert client.established(PORT) == 1  # the client knows of nothing
    assert _reads(client)["seconds"] < SOON + LATE
    assert server.ask("status")["accepted"] == 1


@both_kinds
@pytest.mark.clause("T37")
def test_write_that_a_returned_server_resets_is_not_repeated_and_the_next_one_is_served(
    network: Network, via: str
) -> None:
    here, there = network.host(), network.host()
    _server(there)
    client = _client(here, via, there, timeout=10)
    _reads(client)
    there.crash()
    there.boot()
    server = _server(there)
    server.ready()
    answer = client.ask("write", address=6)
    assert (answer["error"], answer["cause"]) == ("WriteOutcomeUnknown", "LinkDown"), answer
    assert server.ask("status")["requests"] == 0
    assert "value" in client.ask("write", address=6)


@both_kinds
def test_connection_to_a_returned_server_ends_by_the_first_probe_where_nothing_is_asked(
    network: Network, via: str
) -> None:
    here, there = network.host(), network.host()
    _server(there)
    client = _client(here, via, there, **{**SHORT, "keepalive_idle": 2})
    _reads(client)
    there.crash()
    there.boot()
    assert client.established(PORT) == 1
    client.until_established(PORT, 0, 2 + LATE)
    server = _server(there)
    server.ready()
    _reads(client)
    assert server.ask("status")["accepted"] == 1


# --- §4.2.2.3: the client crashes, and comes back ------------------------------------------------------------


@both_kinds
def test_client_that_was_killed_leaves_no_connection(network: Network, via: str) -> None:
    here, there = network.host(), network.host()
    server, client = _server(there, **NEVER), _client(here, via, there)
    _reads(client)
    client.kill()
    assert server.ask("until", connections=0, seconds=SOON)["connections"] == []


@both_kinds
@pytest.mark.clause("T19")
def test_client_that_came_back_by_another_port_is_served_and_its_old_connection_ends_by_keepalive(
    network: Network, via: str
) -> None:
    here, there = network.host(), network.host()
    server = _server(there, **SHORT)
    _reads(_client(here, via, there))
    (old,) = server.ask("status")["connections"]
    here.crash()
    here.boot()
    client = _client(here, via, there)
    assert _reads(client)["seconds"] < SOON
    left = server.ask("until", connections=1, seconds=KEEPALIVE + LATE)["connections"]
    assert len(left) == 1
    assert old not in left
    _reads(client)


@both_kinds
@pytest.mark.parametrize("limit", [{"max_connections": 1}, {"max_per_host": 1}], ids=str)
def test_client_that_came_back_takes_the_place_of_its_half_open_past_where_it_may_have_one(
    network: Network, via: str, limit: dict[str, int]
) -> None:
    here, there = network.host(), network.host()
    server = _server(there, **limit, **NEVER)
    handles = server.ask("status")["handles"]
    for _ in range(3):
        client = _client(here, via, there)
        assert _reads(client)["seconds"] < SOON
        assert len(server.ask("status")["connections"]) == 1
        here.crash()
        here.boot()
    status = server.ask("status")
    assert (status["accepted"], status["evicted"], status["handles"]) == (3, 2, handles + 1)


@pytest.mark.clause("T13", "T19")
def test_marked_client_that_came_back_is_served_at_once_and_moves_up_when_its_half_open_past_ends(
    network: Network,
) -> None:
    here, there = network.host(), network.host()
    limits = {"priority": [here.address], "max_priority_connections": 1, "max_connections": 1}
    server = _server(there, **SHORT, **limits)
    _reads(_client(here, "asyncio", there))
    assert server.ask("status")["pools"] == ["priority"]
    (old,) = server.ask("status")["connections"]
    here.crash()
    here.boot()
    client = _client(here, "asyncio", there)
    assert _reads(client)["seconds"] < SOON
    # We close no connection of a priority host: the past one ends because the system finds that its peer is gone.
    left = server.ask("until", connections=1, seconds=KEEPALIVE + LATE)
    assert left["connections"] != [old]
    assert (left["pools"], left["evicted"], left["closed"]) == (["priority"], 0, 1)
    _reads(client)


def test_client_that_came_back_by_the_same_port_is_accepted_and_its_half_open_past_is_gone(network: Network) -> None:
    here, there = network.host(), network.host()
    server = _server(there, **NEVER)
    old = _fixed(here, there, 40_000)
    assert "error" not in old.ask("connect")
    assert old.ask("read")["value"] == "0001000000050103020005"
    here.crash()
    here.boot()
    new = _fixed(here, there, 40_000)
    # The server's stack answers the opening within the past connection, the client's resets that, and asks once more.
    answer = new.ask("connect")
    assert "error" not in answer, answer
    assert answer["seconds"] < 3 + LATE
    assert new.ask("read")["value"] == "0001000000050103020005"
    status = server.ask("until", connections=1, seconds=SOON)
    assert (status["connections"], status["accepted"]) == ([f"{here.address}:40000"], 2)


def test_place_of_a_client_that_crashed_in_the_middle_of_a_request_is_not_lost(network: Network) -> None:
    here, there = network.host(), network.host()
    server = _server(there, max_connections=1, max_transactions=1, scope="server", **NEVER)
    client = _client(here, "asyncio", there, timeout=10)
    client.tell("read", address=SLOW)
    assert server.ask("until", waiting=1, seconds=10)["waiting"] == 1
    here.crash()
    here.boot()
    client = _client(here, "asyncio", there, timeout=10)
    _reads(client)
    assert server.ask("status")["waiting"] == 0
    client.tell("read", address=SLOW)  # which gets the slot of the one that is not awaited any more
    assert server.ask("until", waiting=1, seconds=10)["waiting"] == 1
    server.ask("go_on")
    assert client.outcome()["value"] == [SLOW]
