"""The resources: what they give, what they take, and the sentences in which they refuse."""

import json

import pytest
from page_plant import watched

import busway


@pytest.fixture
def plant():
    with watched() as running:
        yield running


@pytest.fixture(scope="module")
def still():
    """One that no test changes."""
    with watched() as running:
        yield running


@pytest.fixture
def unit(plant):
    with busway.connect(plant.endpoints[0]) as link:
        yield link.unit(1)


def test_points_come_in_the_order_of_the_file_with_all_that_is_known(still):
    status, answer = still.ask("GET", "/api/points")
    assert status == 200
    assert answer["total"] == 6
    assert [point["key"] for point in answer["points"]][:2] == ["1/tank.level", "1/tank.target"]
    assert [point["index"] for point in answer["points"]] == list(range(6))
    target = answer["points"][1]
    assert target["address"] == "4x1"
    assert target["type"] == "float32"
    assert target["raw"] == "4000 0000"
    assert target["unit_of_measure"] == "m"
    assert (target["minimum"], target["maximum"], target["access"]) == (0, 4, "read-write")
    assert answer["points"][2]["enumeration"] == {"off": 0, "manual": 1, "auto": 2}
    assert "sine" in answer["points"][0]["behaviour"]


def test_points_are_found_by_unit_words_address_and_in_pages(still):
    assert [one["name"] for one in still.ask("GET", "/api/points?unit=2")[1]["points"]] == ["text/label"]
    assert [one["name"] for one in still.ask("GET", "/api/points?search=TANK")[1]["points"]] == [
        "tank.level",
        "tank.target",
    ]
    assert [one["name"] for one in still.ask("GET", "/api/points?search=4X3")[1]["points"]] == ["pump.mode"]
    page = still.ask("GET", "/api/points?skip=1&limit=2")[1]
    assert [one["index"] for one in page["points"]] == [1, 2]
    assert page["total"] == 6


def test_a_value_that_is_set_is_read_by_modbus(plant, unit):
    status, answer = plant.ask("PUT", "/api/units/1/points/tank.target", {"value": 3.5})
    assert (status, answer["value"], answer["last_writer"]) == (200, 3.5, "api")
    assert unit.read("4x1", "float32") == 3.5


def test_a_value_that_modbus_wrote_shows_who_wrote_it(plant, unit):
    unit.write("4x1", 1.25, "float32")
    answer = plant.ask("GET", "/api/units/1/points/tank.target")[1]
    assert answer["value"] == 1.25
    assert answer["last_writer"].startswith("127.0.0.1:")


def test_a_name_stands_for_its_number(plant, unit):
    assert plant.ask("PUT", "/api/units/1/points/pump.mode", {"value": "auto"})[1]["value"] == 2
    assert unit.read("4x3") == 2


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("tank.target", 9, "0…4"),
        ("tank.target", "much", "much"),
        ("pump.mode", "fast", "off, manual, auto"),
        ("pump.mode", 7, "manual"),
        ("pump.enabled", 3, "true or false"),
    ],
)
def test_a_value_that_does_not_fit_is_refused_in_a_sentence(still, name, value, sentence):
    status, answer = still.ask("PUT", f"/api/units/1/points/{name}", {"value": value})
    assert status == 422
    assert sentence in answer["error"]


def test_a_whole_number_beyond_what_a_browser_holds_is_a_text(plant):
    assert plant.ask("GET", "/api/units/1/points/meter.energy")[1]["value"] == "9007199254740993"
    assert plant.ask("PUT", "/api/units/1/points/meter.energy", {"value": 2**60 + 1})[1]["value"] == str(2**60 + 1)


def test_a_number_that_json_has_not_is_a_text_both_ways(plant):
    path = "/api/units/1/points/tank.level"
    assert plant.ask("PUT", path, {"value": "NaN"})[1]["value"] == "NaN"
    assert plant.ask("PUT", path, {"value": "-Infinity"})[1]["value"] == "-Infinity"
    assert plant.ask("GET", "/api/values")[1]["values"]["1/tank.level"] == "-Infinity"


def test_a_name_may_hold_a_slash(plant):
    assert plant.ask("GET", "/api/units/2/points/text%2Flabel")[1]["value"] == "hello"
    assert plant.ask("PUT", "/api/units/2/points/text/label", {"value": "bye"})[1]["value"] == "bye"


def test_a_point_that_was_set_holds_until_it_is_released(plant):
    path = "/api/units/1/points/tank.level"
    assert plant.ask("PUT", path, {"value": 1.0})[1]["held"] is True
    assert plant.ask("POST", "/api/units/1/release/tank.level")[0] == 200


def test_many_values_are_set_one_by_one_and_what_is_refused_is_told(plant):
    status, answer = plant.ask(
        "POST", "/api/values", {"values": {"1/tank.target": 1, "1/pump.mode": "nix", "3/a": 1, "1/pump.enabled": False}}
    )
    assert (status, answer["written"]) == (200, 2)
    assert sorted(answer["refused"]) == ["1/pump.mode", "3/a"]
    values = plant.ask("GET", "/api/values")[1]["values"]
    assert (values["1/tank.target"], values["1/pump.enabled"]) == (1, False)


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/api/units/1/points/nothing"),
        ("GET", "/api/units/9/points/tank.level"),
        ("GET", "/api/units/1/points/"),
        ("POST", "/api/units/1/release/nothing"),
        ("DELETE", "/api/faults/nothing"),
        ("GET", "/api"),
        ("GET", "/../style.css"),
        ("GET", "/uplot/../../api.py"),
    ],
)
def test_what_is_not_there_is_not_found_and_says_so(still, method, path):
    status, answer = still.ask(method, path)
    assert status == 404
    assert answer["error"]


@pytest.mark.parametrize(
    ("body", "status", "word"),
    [
        (b"{", 400, "JSON"),
        (b"[" * 100_000, 400, "JSON"),
        (b"\xff", 400, "JSON"),
        (b"[]", 422, "the body"),
        ({}, 422, "value"),
        ({"value": 1, "values": 2}, 422, "values"),
        ({"value": {"a": 1}}, 422, "value"),
    ],
)
def test_a_body_that_cannot_be_is_refused_with_its_key(still, body, status, word):
    answered, answer = still.ask("PUT", "/api/units/1/points/tank.target", body)
    assert answered == status
    assert word in answer["error"]


def test_a_method_that_a_resource_does_not_take_is_said(still):
    status, answer = still.ask("PUT", "/api/units", {})
    assert status == 405
    assert "PUT" in answer["error"]


def test_a_fault_is_put_on_switched_and_taken_off(plant, unit):
    status, answer = plant.ask(
        "POST",
        "/api/faults",
        {"fault_profile": "busy", "name": "rush", "units": [1], "functions": [3], "first": 0, "last": 9},
    )
    assert status == 201
    assert (answer["name"], answer["fault_profile"], answer["on"]) == ("rush", "busy", True)
    assert answer["selection"] == {"units": [1], "functions": [3], "first": 0, "last": 9}
    with pytest.raises(busway.ExceptionReply) as caught:
        unit.read("4x1", "float32")
    assert caught.value.code == 6
    assert plant.ask("GET", "/api/faults")[1]["faults"][0]["struck"] == 1

    assert plant.ask("PATCH", "/api/faults/rush", {"on": False})[1]["on"] is False
    assert unit.read("4x1", "float32") == 2.0

    assert plant.ask("DELETE", "/api/faults/rush")[0] == 200
    assert plant.ask("GET", "/api/faults")[1]["faults"] == []


@pytest.mark.parametrize(
    ("wanted", "word"),
    [
        ({"fault_profile": "grumpy"}, "grumpy"),
        ({"fault_profile": "busy", "parameters": {"seconds": -1}}, "seconds"),
        ({"fault_profile": "busy", "parameters": {"minutes": 1}}, "minutes"),
        ({"fault_profile": "busy", "first": 9, "last": 3}, "first"),
        ({"fault_profile": "busy", "units": [256]}, "units.0"),
        ({"fault_profile": "busy", "probability": 2}, "probability"),
        ({"fault_profile": "busy", "schedule": {"every": 1, "lasts": 5}}, "lasts"),
    ],
)
def test_a_fault_that_cannot_be_is_refused_with_its_key(still, wanted, word):
    status, answer = still.ask("POST", "/api/faults", wanted)
    assert status == 422
    assert word in answer["error"]
    assert still.ask("GET", "/api/faults")[1]["faults"] == []


def test_all_fault_profiles_are_offered_with_what_they_take(still):
    from busway.testing import FAULT_PROFILES

    offered = {one["name"]: one for one in still.ask("GET", "/api/faults")[1]["fault_profiles"]}
    assert list(offered) == list(FAULT_PROFILES)
    assert offered["late"]["parameters"][0]["name"] == "delay"
    assert offered["late"]["parameters"][0]["kind"] == "float"


def test_connections_counters_and_lines_are_those_of_the_server(plant, unit):
    unit.read("4x1", "float32")
    (connection,) = plant.ask("GET", "/api/connections")[1]["connections"]
    assert connection["requests"] == 1
    assert plant.ask("GET", "/api/counters")[1]["counters"]["requests"] == 1
    (line,) = plant.ask("GET", "/api/lines")[1]["lines"]
    assert line["indicators"]["device_status"] == "on"
    assert line["counters"]["server_message_count"] == 1
    assert plant.ask("POST", "/api/counters/reset")[0] == 200
    assert plant.ask("GET", "/api/counters")[1]["counters"]["requests"] == 0


def test_the_simulation_says_what_it_is(still):
    answer = still.ask("GET", "/api/simulation")[1]
    assert (answer["name"], answer["units"], answer["points"], answer["seed"]) == ("plant", 2, 6, 0)
    assert answer["endpoints"] == still.endpoints
    assert still.ask("GET", "/api/units")[1]["units"] == [
        {"unit": 1, "name": "plant", "points": 5},
        {"unit": 2, "name": "panel", "points": 1},
    ]


def test_the_simulation_is_paused_and_made_faster(plant):
    answer = plant.ask("PATCH", "/api/simulation", {"paused": True, "speed": 50})[1]
    assert (answer["paused"], answer["speed"]) == (True, 50)
    stood = answer["time"]
    assert plant.ask("GET", "/api/simulation")[1]["time"] == stood
    assert plant.ask("PATCH", "/api/simulation", {"paused": False})[1]["paused"] is False
    assert plant.ask("GET", "/api/simulation")[1]["time"] > stood
    assert plant.ask("PATCH", "/api/simulation", {"speed": 0})[0] == 422
    assert plant.ask("PATCH", "/api/simulation", {})[1]["speed"] == 50


def test_the_traffic_is_asked_for_from_a_number_on(plant, unit):
    unit.read("4x1", "float32")
    answer = plant.ask("GET", "/api/traffic")[1]
    assert [frame["direction"] for frame in answer["frames"]] == ["request", "reply"]
    assert "holding register 4x1" in answer["frames"][0]["text"]
    assert answer["frames"][1]["seconds"] >= 0
    assert plant.ask("GET", f"/api/traffic?after={answer['last']}")[1]["frames"] == []
    cut_off = plant.ask("GET", "/api/traffic?after=0&limit=1")[1]
    assert ([frame["number"] for frame in cut_off["frames"]], cut_off["lost"]) == ([answer["last"]], 0)
    assert plant.ask("GET", "/api/traffic?limit=0")[0] == 422


# The document.


def test_every_resource_stands_in_the_document_with_what_it_asks_and_answers(still):
    status, document = still.ask("GET", "/openapi.json")
    assert status == 200
    assert document["openapi"].startswith("3.1")
    declared = {(method.upper(), path) for path, methods in document["paths"].items() for method in methods}
    assert len(declared) >= 18
    names = {one["operationId"] for methods in document["paths"].values() for one in methods.values()}
    assert len(names) == len(declared)
    assert {"list_units", "set_point", "get_counters"} <= names
    for methods in document["paths"].values():
        for operation in methods.values():
            assert operation["responses"]
            assert operation["summary"]
    for variable in ("unit", "name"):
        named = [one["name"] for one in document["paths"]["/api/units/{unit}/points/{name}"]["get"]["parameters"]]
        assert variable in named


def test_every_reference_in_the_document_leads_somewhere(still):
    document = still.ask("GET", "/openapi.json")[1]
    schemas = document["components"]["schemas"]
    text = json.dumps(document)
    references = {part.partition('"')[0] for part in text.split('"$ref": "')[1:]}
    assert references
    for reference in references:
        assert reference.startswith("#/components/schemas/")
        assert reference.rpartition("/")[2] in schemas


def test_document_says_what_is_asked_what_is_answered_and_how_it_is_authorized(still):
    document = still.ask("GET", "/openapi.json")[1]
    change = document["paths"]["/api/units/{unit}/points/{name}"]["put"]
    assert change["requestBody"]["content"]["application/json"]["schema"]["$ref"].endswith("/NewValue")
    assert change["responses"]["200"]["content"]["application/json"]["schema"]["$ref"].endswith("/PointAnswer")
    for status in ("401", "404", "422"):
        assert change["responses"][status]["content"]["application/json"]["schema"]["$ref"].endswith("/Failure")
    assert "201" in document["paths"]["/api/faults"]["post"]["responses"]
    query = {one["name"] for one in document["paths"]["/api/points"]["get"]["parameters"] if one["in"] == "query"}
    assert query == {"unit", "search", "limit", "skip"}
    assert document["components"]["securitySchemes"]["token"]["scheme"] == "bearer"
    assert document["security"] == [{"token": []}, {}]


@pytest.mark.parametrize(
    "value",
    [
        b"[" * 500 + b"]" * 500,
        b'{"a":' * 500 + b"1" + b"}" * 500,
        b"[" * 100_000,
        b'"\\u0000"',
        b'"\\ud800"',
        b"9" * 4200,
        b"9" * 5000,
        b'"' + b"9" * 5000 + b'"',
        b'"${' + b"9" * 4300 + b'}"',
        b"1e400",
    ],
    ids=["lists", "objects", "endless", "nul", "surrogate", "many digits", "too many", "in text", "parameter", "inf"],
)
def test_odd_values_are_refused_in_a_sentence_wherever_they_stand(still, value, caplog):
    for method, path, key in (
        ("PUT", "/api/units/1/points/tank.target", "value"),
        ("PUT", "/api/units/1/points/meter.energy", "value"),
        ("PATCH", "/api/simulation", "speed"),
        ("POST", "/api/faults", "fault_profile"),
        ("POST", "/api/faults", "units"),
    ):
        status, content = still.ask(method, path, b'{"' + key.encode() + b'":' + value + b"}")
        assert 400 <= status < 500, (path, content)
        assert content["error"]
        assert "set_int_max_str_digits" not in content["error"]
    assert not caplog.records
