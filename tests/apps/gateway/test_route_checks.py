"""What of the routes of a gateway file cannot work, and what is odd: each with file, line and key."""

import tomllib

import pytest

from busway.apps.gateway.configuration import parse_gateway
from busway.apps.gateway.file_routes import placed_routes
from busway.apps.gateway.gateway_plan import UpstreamSettings
from busway.apps.gateway.route_checks import worst_case
from busway.apps.gateway.routes import ALL_UNITS, Route
from busway.config.files.file_error import FileError
from busway.config.files.gateway import GatewayFile
from busway.config.files.toml_source import Source
from busway.config.report import ConfigurationReport

LISTENER = '[[listener]]\nname = "net"\nurl = "tcp://127.0.0.1:5020"\n'
SERIAL_LISTENER = '[[listener]]\nname = "plc"\nurl = "rtu:///dev/not-there-1?baud=19200"\n'
LINE = '[[link]]\nname = "hall"\nurl = "rtu:///dev/not-there-2?baud=19200"\n'
SERVER = '[[link]]\nname = "server"\nurl = "tcp://10.0.0.5"\n'


def route(line: str, **keys: object) -> str:
    said = "".join(f"{name} = {value!r}\n".replace("True", "true") for name, value in keys.items())
    return f'[[route]]\nlink = "{line}"\n{said}'


def refused(*parts: str) -> list[str]:
    """The sentences about a file that cannot work, without its name."""
    with pytest.raises(FileError) as caught:
        parse_gateway("".join(parts), "x.toml")
    return [line.removeprefix("x.toml:") for line in str(caught.value).splitlines()]


def warned(*parts: str) -> list[str]:
    """The warnings about a file that works."""
    return [
        str(one).removeprefix("x.toml:") for one in parse_gateway("".join(parts), "x.toml", preflight=True).warnings
    ]


def test_a_file_without_routes_sends_everything_to_its_one_line() -> None:
    assert [one.units for one in parse_gateway(LISTENER + SERVER, "x").plan.table.routes] == [ALL_UNITS]
    assert [one.units for one in parse_gateway(LISTENER + LINE, "x").plan.table.routes] == [frozenset(range(1, 248))]


def test_a_route_without_units_is_for_those_that_its_line_can_have_behind() -> None:
    def units(text: str) -> frozenset[int]:
        return parse_gateway(LISTENER + LINE + SERVER + text, "x").plan.table.routes[0].units

    assert units(route("hall", unit_offset=-100)) == frozenset(range(101, 256))
    assert units(route("hall", unit=5)) == frozenset(range(1, 248))
    assert units(route("server", unit=5)) == ALL_UNITS
    assert units("[[route]]\nrefuse = 2\n") == ALL_UNITS


def test_a_route_that_an_earlier_one_hides_is_refused() -> None:
    assert refused(LISTENER, LINE, SERVER, route("hall", units="1-10"), route("server", units="5-6")) == [
        "13: route[1]: is never reached: route[0] before it takes all its requests"
    ]


def test_a_route_that_earlier_ones_hide_together_is_refused() -> None:
    routes = [route("hall", units="1-5"), route("server", units="6-9"), route("server", units="4-7", functions=[3])]
    assert refused(LISTENER, LINE, SERVER, *routes) == [
        "16: route[2]: is never reached: route[0] and route[1] before it take all its requests"
    ]


def test_units_that_an_earlier_route_takes_are_a_warning_and_what_is_left_for_the_rest_is_none() -> None:
    first = route("hall", units="1-5", name="the hall")
    assert warned(LISTENER, LINE, SERVER, first, route("server", units="4-7")) == [
        "16: route[1].units: warning: route[0] (the hall) before it takes units 4-5"
    ]
    assert warned(LISTENER, LINE, SERVER, first, route("server", functions=[3])) == []
    assert warned(LISTENER, LINE, SERVER, first, route("server")) == []


def test_a_refusal_behind_the_routes_that_it_was_meant_for_is_refused() -> None:
    late = '[[route]]\nfunctions = "write"\nrefuse = 1\n'
    assert refused(LISTENER, LINE, route("hall", units="1-5"), late) == [
        "10: route[1]: route[0] before it takes units 1-5, which it is to refuse; a refusal stands before what it is "
        "an exception of"
    ]


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"units": "248"}, "9: route[0].units: unit 248 would be 248 on 'hall', a serial line, which has units 1…247"),
        ({"units": "1,0"}, "9: route[0].units: unit 0 would be 0 on 'hall', where no unit answers; a broadcast goes"),
        ({"units": "1", "unit": 250}, "10: route[0].unit: unit 1 would be 250 on 'hall', a serial line"),
        ({"unit": 0}, "9: route[0].unit: unit 1 would be 0 on 'hall', where no unit answers"),
        ({"units": "5", "unit_offset": -6}, "10: route[0].unit_offset: unit 5 would become -1"),
        ({"units": "200", "unit_offset": 50}, "10: route[0].unit_offset: unit 200 would be 250 on 'hall'"),
        ({"unit_offset": 255}, "9: route[0].unit_offset: leaves no unit that 'hall' has"),
        ({"unit": 5, "unit_offset": 1}, "10: route[0].unit_offset: either a unit or an offset, not both"),
        (
            {"table": "holding", "addresses": "0-9", "shift": -1},
            "11: route[0].shift: holding register 0…9 would become -1…8, which do not exist",
        ),
        (
            {"table": "holding", "addresses": "0-9", "functions": [1, 4]},
            "11: route[0].functions: none of them reads or writes holding registers",
        ),
    ],
)
def test_a_unit_or_address_that_the_line_cannot_have_is_refused(keys: dict[str, object], sentence: str) -> None:
    found = refused(LISTENER, LINE, route("hall", **keys))
    assert len(found) == 1
    assert found[0].startswith(sentence)


def test_a_unit_that_no_master_can_ask_a_serial_listener_for_is_refused() -> None:
    only = route("server", units="1, 250", listeners=["plc"])
    assert refused(LISTENER, SERIAL_LISTENER, SERVER, route("server", units="3"), only) == [
        "15: route[1].units: clients of plc cannot ask unit 250: a serial line has units 1…247"
    ]
    for_all = route("server", units="1, 250")
    assert warned(LISTENER, SERIAL_LISTENER, SERVER, for_all) == []
    assert len(refused(SERIAL_LISTENER, SERVER, for_all)) == 1


def test_a_serial_listener_that_no_route_gives_a_unit_is_refused_and_a_network_listener_without_a_line_is_odd() -> None:
    assert refused(LISTENER, SERIAL_LISTENER, SERVER, route("server", listeners=["net"])) == [
        "6: listener[1].url: no route has a unit that can be asked here: a serial line has units 1…247"
    ]
    other = LISTENER.replace("net", "office").replace("5020", "5021")
    assert warned(LISTENER, other, SERVER, route("server", listeners=["net"])) == [
        "6: listener[1].url: warning: no route leads from here to a link"
    ]


def test_a_client_that_gives_up_before_the_line_can_have_answered_is_refused_with_the_figures() -> None:
    impatient = LISTENER + "client_deadline = 1.0\n"
    (sentence,) = refused(impatient, LINE, "timeout = 0.6\n")
    assert sentence == (
        "4: listener[0].client_deadline: 1 s is less than link 'hall' may take: "
        "1.31 s = (1 + 1 retry) × (0.6 s timeout + 0.0546 s for frames and silence)"
    )
    assert warned(impatient, LINE, "timeout = 0.4\n") == []
    # The timeout of a route goes before that of its line, and a split read is several requests.
    assert len(refused(impatient, LINE, "timeout = 0.4\n", route("hall", timeout=0.7))) == 1
    assert "× 5 pieces" in refused(impatient, LINE, "timeout = 0.3\n", route("hall", max_registers=25))[0]


@pytest.mark.parametrize(
    ("earlier", "refusal", "part"),
    [
        ('units = "5-20"', 'units = "1-10"', "units 5-10"),
        ("units = 5", 'units = "1-10"\nfunctions = [6]', "units 5"),
        ('units = "5-20"', "functions = [6]", "units 5-20"),
        ("functions = [3, 16]", "functions = [6, 16]", "functions 16"),
        ('addresses = "4x51-4x150"', 'addresses = "4x1-4x100"', "holding registers 50…99"),
        ('units = 3\naddresses = "4x51-4x150"', 'units = "3-4"\naddresses = "4x1-4x100"', "holding registers 50…99"),
        ('listeners = ["net"]\nunits = 5', 'units = "1-10"', "units 5"),
    ],
)
def test_a_refusal_of_which_an_earlier_route_takes_a_part_is_refused(earlier: str, refusal: str, part: str) -> None:
    (sentence,) = refused(
        LISTENER, LINE, f'[[route]]\nlink = "hall"\n{earlier}\n', f"[[route]]\nrefuse = 2\n{refusal}\n"
    )
    assert "route[1]: route[0] before it takes " + part.replace("holding registers", "holding register") in sentence


@pytest.mark.parametrize(
    ("earlier", "refusal"),
    [
        ("units = 5", ""),  # a refusal of the rest
        ('functions = ["read"]', 'units = "1-10"'),
        ('addresses = "4x1-4x100"', 'units = "1-10"'),
        ('units = "5-20"', 'units = "1-4"'),
        ('addresses = "4x51-4x150"', 'addresses = "4x1-4x50"'),
        ('addresses = "3x51-3x150"', 'addresses = "4x1-4x100"'),
    ],
)
def test_a_refusal_of_what_others_have_left_is_none_that_is_hidden(earlier: str, refusal: str) -> None:
    assert warned(LISTENER, LINE, f'[[route]]\nlink = "hall"\n{earlier}\n', f"[[route]]\nrefuse = 2\n{refusal}\n") == []


def rules(*each: str, default: str = "allow") -> str:
    return f'[policy]\ndefault = "{default}"\n' + "".join(f"[[policy.rule]]\n{one}\n" for one in each)


MERGED = LISTENER, LINE, route("hall", units="1-10"), route("hall", units="101-110", unit_offset=-100)


@pytest.mark.parametrize(
    "rule",
    [
        'name = "r"\naction = "deny"\nunits = 3',
        'action = "allow"\nunits = 3\nrate = 1',
        'action = "read-only"\nunits = 3',
    ],
)
def test_a_second_route_to_the_device_of_a_rule_is_odd_where_the_rule_does_not_name_its_unit(rule: str) -> None:
    (sentence,) = warned(*MERGED, rules(rule))
    assert sentence.endswith(
        "warning: does not hold for unit 103, which route[1] leads to the same device as unit 3: unit 3 of line 'hall'"
    )
    assert "policy.rule[0]" in sentence


@pytest.mark.parametrize(
    "policy",
    [
        rules('action = "deny"\nunits = "3, 103"'),
        rules('action = "deny"\nunits = 3', 'action = "deny"\nunits = 103'),
        rules('action = "deny"\nfunctions = [6]'),
        rules('action = "allow"\nunits = 3', default="deny"),
        rules('action = "deny"\nunits = 3\nfunctions = [6]', 'action = "allow"\nunits = 3', default="deny"),
        rules('action = "deny"\nunits = 20'),
    ],
)
def test_rules_that_hold_for_all_ways_to_their_devices_are_not_odd(policy: str) -> None:
    assert warned(*MERGED, policy) == []


def test_a_way_that_another_rule_closes_too_is_not_odd_though_the_rules_differ() -> None:
    near = 'action = "deny"\nunits = 3\naccess = "write"'
    assert warned(*MERGED, rules(near, 'action = "read-only"\nunits = 103')) == []
    holding = 'action = "deny"\nunits = 3\nfunctions = [6]'
    far = 'action = "deny"\nunits = 103\nfunctions = [6]\naddresses = "4x1-4x{}"'
    assert warned(*MERGED, rules(holding, far.format(65536))) == []
    (sentence,) = warned(*MERGED, rules(holding, far.format(10)))
    assert "policy.rule[0]" in sentence
    assert "does not hold for unit 103" in sentence


def test_a_unit_that_is_said_to_be_the_same_device_is_another_way_to_it() -> None:
    hall = LINE + "same_device = [[3, 4]]\n"
    (sentence,) = warned(LISTENER, hall, rules('action = "deny"\nunits = 3'))
    assert "does not hold for unit 4" in sentence
    assert warned(LISTENER, hall, rules('action = "deny"\nunits = "3-4"')) == []


def test_a_rule_is_compared_with_what_its_own_clients_may_do_by_the_other_way() -> None:
    rule = 'action = "deny"\npeers = ["10.0.0.0/8"]\nunits = 3'
    assert warned(*MERGED, rules(rule, 'action = "allow"\npeers = ["10.1.0.0/16"]\nunits = 103', default="deny")) == []
    assert len(warned(*MERGED, rules(rule, 'action = "allow"\nunits = 103', default="deny"))) == 1


def test_a_way_whose_route_takes_no_function_of_the_rule_is_not_odd() -> None:
    reads = '[[route]]\nlink = "hall"\nunits = "101-110"\nunit_offset = -100\nfunctions = ["read"]\n'
    deny_writes = 'action = "deny"\nunits = 3\naccess = "write"'
    assert warned(LISTENER, LINE, route("hall", units="1-10"), reads, rules(deny_writes)) == []
    assert len(warned(LISTENER, LINE, route("hall", units="1-10"), reads, rules('action = "deny"\nunits = 3'))) == 1


def test_a_route_that_calls_the_registers_of_a_rule_by_other_addresses_is_odd() -> None:
    near = route("hall", units=3, addresses="4x1-4x100")
    far = route("hall", units=3, addresses="4x1001-4x1100", shift=-1000)
    rule = 'action = "deny"\nunits = 3\naddresses = "4x11-4x20"'
    (sentence,) = warned(LISTENER, LINE, near, far, rules(rule))
    assert sentence.endswith(
        "warning: does not hold for holding registers 1010…1019 of unit 3: by route[1] these are the same as its "
        "10…19, which it names"
    )
    both = 'action = "deny"\nunits = 3\naddresses = ["4x11-4x20", "4x1011-4x1020"]'
    assert warned(LISTENER, LINE, near, far, rules(both)) == []


def test_a_line_that_is_slower_than_the_default_deadline_of_a_listener_is_odd_and_told_with_the_figures() -> None:
    (sentence,) = warned(LISTENER, LINE, "timeout = 1.5\n")
    assert sentence == (
        "4: link[0]: warning: link 'hall' may take 3.11 s = (1 + 1 retry) × (1.5 s timeout + 0.0546 s for frames and "
        "silence), and clients are answered 0B after 2.5 s; set client_deadline of the listener (beside "
        "URLs: --client-deadline) to what its clients wait, or a shorter timeout"
    )
    assert warned(LISTENER, LINE) == []
    assert warned(LISTENER, SERVER) == []
    assert warned(LISTENER + "client_deadline = 4.0\n", LINE, "timeout = 1.5\n") == []
    assert warned(LISTENER + 'client_deadline = "none"\n', LINE, "timeout = 1.5\n") == []
    slow_route = route("hall", units="3", timeout=2.0)
    assert len(warned(LISTENER, LINE, slow_route)) == 1


def test_a_deadline_out_of_range_is_refused() -> None:
    (sentence,) = refused(LISTENER + "client_deadline = 0\n", LINE)
    assert sentence.startswith("4: listener[0].client_deadline: ")


def test_the_delay_after_connecting_is_a_part_of_the_worst_case() -> None:
    link = SERVER + "connect_delay = 2.0\nretries = 0\n"
    (sentence,) = warned(LISTENER, link)
    assert "3 s = (1 + 0 retries) × (1 s timeout) + 2 s connect_delay" in sentence
    (sentence,) = refused(LISTENER + "client_deadline = 2.9\n", link)
    assert "client_deadline: 2.9 s is less than link" in sentence
    assert warned(LISTENER + "client_deadline = 3.0\n", link) == []


def test_the_worst_case_of_a_write_has_no_retries_and_the_longest_frame() -> None:
    line = UpstreamSettings.of("x", "rtu:///dev/x?baud=1200", timeout=1.0, retries=0)
    case = worst_case(line, Route(upstream="x"))
    assert case.seconds == pytest.approx(1.0 + 0.05 + 256 * 11 / 1200)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            LISTENER + '[[link]]\nname = "x"\nurl = "tcp://localhost:5020"\n',
            "6: link[0].url: leads back to the gateway itself, to listener net",
        ),
        (
            LISTENER.replace("127.0.0.1", "") + '[[link]]\nname = "x"\nurl = "tcp://[::1]:5020"\n',
            "6: link[0].url: leads back to the gateway itself, to listener net",
        ),
        (
            SERIAL_LISTENER + '[[link]]\nname = "x"\nurl = "ascii:///dev/not-there-1"\n',
            "6: link[0].url: /dev/not-there-1 is taken by listener plc",
        ),
        (
            LISTENER + LINE + LINE.replace("hall", "yard") + route("hall", units="1") + route("yard", units="2"),
            "9: link[1].url: /dev/not-there-2 is taken by link 'hall'",
        ),
        (LISTENER + LINE + "connections = 2\n", "7: link[0].connections: a serial port is opened once"),
    ],
)
def test_a_line_that_leads_back_or_wants_a_port_that_is_taken_is_refused(text: str, sentence: str) -> None:
    assert refused(text) == [sentence]


def test_a_line_without_a_route_and_two_lines_to_one_server_are_odd() -> None:
    assert warned(LISTENER, LINE, SERVER, route("hall")) == ["8: link[1].name: warning: no route leads to 'server'"]
    again = SERVER.replace("server", "again")
    routes = route("server", units="1") + route("again", units="2")
    assert warned(LISTENER, SERVER, again, routes) == [
        "9: link[1].url: warning: tcp://10.0.0.5:502 is the server of link 'server' too: "
        "each has connections of its own"
    ]


def test_what_is_wrong_with_the_default_route_of_a_link_is_reported_at_that_link() -> None:
    data = tomllib.loads(LISTENER + LINE + SERVER + route("server"))
    file = GatewayFile.model_validate(data).model_copy(update={"route": []})
    upstreams = {"server": UpstreamSettings.of("server", "tcp://10.0.0.5")}
    (found,) = placed_routes(file, upstreams, ConfigurationReport(Source("x.toml", data, {})))
    assert found.place == ("link", 1)


def test_a_route_that_hides_the_own_unit_is_odd_where_one_of_them_was_written() -> None:
    assert warned(LISTENER, SERVER) == []
    assert warned(LISTENER, SERVER, route("server", units="250-255")) == [
        "9: route[0].units: warning: takes unit 255, which could be the gateway's own"
    ]
    assert warned(LISTENER, SERVER, "[gateway]\nown_unit = 17\n") == [
        "4: link[0]: warning: takes unit 17, which could be the gateway's own"
    ]
    assert warned(LISTENER, SERVER, "[gateway]\nown_unit = 'none'\n") == []


def test_a_listener_that_the_network_reaches_and_roles_without_tls_are_warned_of_as_with_servers() -> None:
    text = LISTENER.replace("127.0.0.1", "0.0.0.0") + SERVER
    rules = '[policy]\ndefault = "deny"\n[[policy.rule]]\nname = "x"\nroles = ["a"]\n'
    assert warned(text, rules) == [
        "3: listener[0].url: warning: tcp://0.0.0.0:5020 listens on every interface of this host",
        "11: policy.rule[0].roles: warning: no client can have a role: there is no tls:// listener",
    ]


def test_a_rule_that_can_never_decide_is_warned_of() -> None:
    rules = '[policy]\ndefault = "deny"\n[[policy.rule]]\nname = "a"\n[[policy.rule]]\nname = "b"\nunits = "1"\n'
    assert warned(LISTENER, SERVER, rules) == [
        "11: policy.rule[1]: warning: 'b' never decides: 'a' before it takes all its requests"
    ]


def test_gaps_of_routes_are_those_of_the_units_behind_on_serial_lines_only() -> None:
    slow = route("hall", units="101-102", unit_offset=-100, request_gap=0.5)
    plan = parse_gateway(LISTENER + LINE + slow + route("hall", units="2", request_gap=0.7), "x").plan
    assert plan.upstreams[0].unit_gaps == {1: 0.5, 2: 0.7}
    assert refused(LISTENER, SERVER, route("server", units="1", request_gap=0.5)) == [
        "10: route[0].request_gap: is an option of the link where that is no serial line"
    ]
    impatient = LISTENER + "client_deadline = 1.5\n"
    assert "+ 0.505 s for frames" in refused(impatient, LINE, "timeout = 0.4\n", route("hall", request_gap=0.5))[0]
