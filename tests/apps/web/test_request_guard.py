"""Who may ask the API: Host, Origin, token and sizes, before anything of a request is read."""

import pytest
from page_plant import watched
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.apps.web.request_guard import BODY_LIMIT
from busway.apps.web.simulation_page import ControlPage
from busway.errors import ConfigError

TOKEN = "a-token-that-a-person-chose"
UNIT = '[[unit]]\nunit = 1\nholding_registers = 4\n[[unit.point]]\nname = "a"\naddress = "4x1"\n'


@pytest.fixture(scope="module")
def plant():
    with watched(UNIT) as running:
        yield running


@pytest.fixture(scope="module")
def guarded():
    with watched(UNIT, token=TOKEN) as running:
        yield running


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:80", "localhost:8502", "[::1]:8502", "LOCALHOST"])
def test_a_host_of_loopback_is_answered(plant, host):
    assert plant.ask("GET", "/api/units", Host=host)[0] == 200


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8502", "127.0.0.1.evil.example", "10.0.0.7:80", ""])
def test_a_name_that_was_pointed_at_loopback_is_refused(plant, host):
    status, answer = plant.ask("GET", "/api/units", Host=host)
    assert status == 403
    assert "Host" in answer["error"]


def test_a_page_of_another_origin_is_refused(plant):
    assert plant.ask("GET", "/api/units", Origin="http://evil.example")[0] == 403
    assert plant.ask("GET", "/api/units", Origin="null")[0] == 403
    assert plant.ask("GET", "/api/units", Origin=f"http://{plant.host}")[0] == 200


def test_another_port_of_this_host_is_another_origin(plant):
    assert plant.ask("PUT", "/api/units/1/points/a", {"value": 1}, Origin="http://127.0.0.1:1")[0] == 403


def test_a_request_that_another_site_made_changes_nothing(plant):
    changed = plant.ask("PUT", "/api/units/1/points/a", {"value": 7}, Sec_Fetch_Site="cross-site")
    assert changed[0] == 403
    assert plant.ask("GET", "/api/units/1/points/a")[1]["value"] == 0


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", ""])
def test_what_a_form_can_send_changes_nothing(plant, kind):
    status, answer = plant.ask("POST", "/api/values", {"values": {"1/a": 7}}, Content_Type=kind)
    assert status == 415
    assert "application/json" in answer["error"]


def test_a_header_that_says_two_things_is_refused(plant):
    import http.client

    connection = http.client.HTTPConnection(plant.host, timeout=60)
    connection.putrequest("GET", "/api/units", skip_host=True)
    connection.putheader("Host", "127.0.0.1")
    connection.putheader("Origin", f"http://{plant.host}")
    connection.putheader("Origin", "http://evil.example")
    connection.endheaders()
    assert connection.getresponse().status == 400
    connection.close()


def test_a_body_that_is_too_large_is_refused_before_it_is_read(plant):
    status, answer = plant.ask(
        "POST", "/api/values", Content_Length=str(BODY_LIMIT + 1), Content_Type="application/json"
    )
    assert status == 413
    assert str(BODY_LIMIT) in answer["error"]


def test_a_body_of_unknown_length_is_read_up_to_the_limit(plant):
    import http.client

    def pieces():
        for _ in range(BODY_LIMIT // 65_536 + 2):
            yield b" " * 65_536

    connection = http.client.HTTPConnection(plant.host, timeout=60)
    headers = {"Content-Type": "application/json", "Transfer-Encoding": "chunked"}
    connection.request("POST", "/api/values", pieces(), headers, encode_chunked=True)
    assert connection.getresponse().status == 413
    connection.close()


# With a token.


def test_the_api_needs_the_token_and_the_page_does_not(guarded):
    assert guarded.exchange("GET", "/")[0] == 200
    assert guarded.exchange("GET", "/app.js")[0] == 200
    status, answer = guarded.ask("GET", "/api/units")
    assert status == 401
    assert "token" in answer["error"]
    assert guarded.ask("GET", "/openapi.json")[0] == 401


@pytest.mark.parametrize(
    "given", [f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}", f"Basic {TOKEN}", TOKEN, "Bearer", "Bearer é"]
)
def test_a_wrong_token_is_refused(guarded, given):
    assert guarded.ask("GET", "/api/units", Authorization=given)[0] == 401


@pytest.mark.parametrize("given", [f"Bearer {TOKEN}", f"bearer {TOKEN}"])
def test_the_right_token_is_taken(guarded, given):
    assert guarded.ask("GET", "/api/units", Authorization=given)[0] == 200


def test_a_token_in_the_address_is_none(guarded):
    assert guarded.ask("GET", f"/api/units?token={TOKEN}")[0] == 401


def test_the_stream_takes_the_token_as_a_subprotocol(guarded):
    address = f"ws://{guarded.host}/stream"
    with connect(address, subprotocols=["busway", f"bearer.{TOKEN}"], proxy=None) as socket:
        assert socket.subprotocol == "busway"
        assert "status" in socket.recv(timeout=10)
    with pytest.raises(InvalidStatus), connect(address, subprotocols=["busway", "bearer.wrong"], proxy=None):
        pass
    with pytest.raises(InvalidStatus), connect(address, proxy=None):
        pass


def test_the_stream_refuses_pages_of_another_origin(plant):
    with pytest.raises(InvalidStatus), connect(f"ws://{plant.host}/stream", origin="http://evil.example", proxy=None):
        pass


def test_an_address_of_the_network_gets_a_token_that_cannot_be_guessed():
    with watched(UNIT, "0.0.0.0:0") as one, watched(UNIT, "0.0.0.0:0") as other:
        port = one.host.rpartition(":")[2]
        assert len(one.page.token) >= 32
        assert one.page.token != other.page.token
        assert one.page.page_url == one.page.announced_url == f"{one.page.url}#token={one.page.token}"
        one.page.url = f"http://127.0.0.1:{port}/"
        assert one.ask("GET", "/api/units")[0] == 401
        assert one.ask("GET", "/api/units", Authorization=f"Bearer {one.page.token}", Host="plc.example")[0] == 200


@pytest.mark.parametrize("token", ["short", "spaces are not in tokens", "né-à-la-mer-du-nord"])
def test_a_token_that_cannot_be_is_refused(token):
    with pytest.raises(ConfigError, match="token"):
        ControlPage(Simulation(parse_declaration(UNIT, "unit.toml")), token=token)
