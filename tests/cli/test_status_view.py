"""How a status is worded: times, sizes, and what is left out."""

from typing import Any

import pytest

from busway.cli.status_view import duration, list_of_programs, sections_of, size


def told(**state: Any) -> dict[str, Any]:
    """What a program tells."""
    status = {"running": True, "uptime": 61.0, "endpoints": ["tcp://10.0.0.1:502"], **state}
    return {"name": "plant", "pid": 4711, "version": "1.2", "status": status}


def listener(**fields: Any) -> dict[str, Any]:
    """A listener as JSON."""
    indicators = {"communication": "off", "error": "off", "device_status": "on"}
    return {
        "endpoint": "tls://10.0.0.1:802",
        "is_open": True,
        "indicators": indicators,
        "counters": {},
        "requests": 0,
        **fields,
    }


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0, "0.0 s"),
        (9.94, "9.9 s"),
        (119.4, "119 s"),
        (120, "2 min"),
        (7199, "119 min"),
        (7200, "2 h 0 min"),
        (48 * 3600, "2 d 0 h"),
        (1e7, "115 d 17 h"),
    ],
)
def test_times_have_two_units_at_most(seconds: float, words: str) -> None:
    assert duration(seconds) == words


@pytest.mark.parametrize(
    ("number", "words"), [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (4_512_000, "4.5 MB"), (1e15, "1000.0 TB")]
)
def test_sizes_have_a_unit(number: float, words: str) -> None:
    assert size(number) == words


@pytest.mark.clause("S19")
def test_indicators_are_words_and_colours() -> None:
    indicators = {"communication": "on", "error": "flashing", "device_status": "off"}
    (_, section) = sections_of(told(listeners=[listener(indicators=indicators)]))
    row = dict(zip(section.columns, section.rows[0], strict=True))
    assert (row["communication"], row["error"], row["device"]) == ("on", "flashing", "off")
    styles = {name: section.style_of(index, row[name]) for index, name in enumerate(section.columns)}
    assert styles["error"] == "yellow"
    assert styles["communication"] == "green"
    steady = dict(indicators, error="on")
    (_, section) = sections_of(told(listeners=[listener(indicators=steady)]))
    assert "red" in section.style_of(list(section.columns).index("error"), "on")


def test_a_column_that_says_nothing_is_left_out_and_an_unknown_one_is_shown() -> None:
    sections = sections_of(told(listeners=[listener(foreign=0, damaged=3, novelty=7, interfaces=[])]))
    columns = sections[-1].columns
    assert {"damaged", "novelty"} <= set(columns)
    assert not {"foreign", "interfaces", "counters", "security"} & set(columns)


def test_counters_that_are_zero_are_left_out_and_classes_are_named() -> None:
    counters = {"accepted": 3, "evicted": 0, "rate_limited": 2, "priority": {"accepted": 1, "sent": 2048}}
    section = sections_of(told(counters=counters))[-1]
    assert section.rows == [
        ["accepted", "3"],
        ["rate limited", "2"],
        ["priority: accepted", "1"],
        ["priority: sent", "2.0 kB"],
    ]
    assert len(sections_of(told(counters={"accepted": 0}))) == 1


def test_places_and_refusals_are_told() -> None:
    sections = sections_of(
        told(supported_connections=64, remote_connections=3, local_connections=1, refusals={"no writes": 4, "x": 0})
    )
    assert sections[1].title == "3 remote connections of 64 supported, 1 local"
    assert sections[2].rows == [["no writes", "4"]]


@pytest.mark.clause("T20")
def test_the_interfaces_of_a_listener_are_told_with_netmask_and_gateway_but_loopback() -> None:
    interfaces = [
        {"name": "lo", "address": "127.0.0.1", "netmask": "255.0.0.0", "gateway": ""},
        {"name": "eth0", "address": "10.0.0.5", "netmask": "255.255.255.0", "gateway": "10.0.0.1"},
    ]
    section = sections_of(told(listeners=[listener(interfaces=interfaces)]))[-1]
    assert section.columns == ("listener", "interface", "address", "netmask", "gateway")
    assert section.rows == [["tls://10.0.0.1:802", "eth0", "10.0.0.5", "255.255.255.0", "10.0.0.1"]]
    assert len(sections_of(told(listeners=[listener(interfaces=interfaces[:1])]))) == 2


@pytest.mark.parametrize(
    ("days", "words"), [(100, "in 100 days"), (12, "in 12 days; renew it"), (-1, "EXPIRED on 2026-01-01")]
)
def test_the_expiry_of_a_certificate_is_told(days: float, words: str) -> None:
    security = {
        "subject": "CN=plant",
        "not_after": 1767225600.0,
        "days_left": days,
        "established": 5,
        "refused": {"expired": 2, "no role": 0},
    }
    section = sections_of(told(listeners=[listener(security=security)]))[-1]
    assert section.rows[0][:2] == ["tls://10.0.0.1:802", "CN=plant"]
    assert words in section.rows[0][2]
    assert section.rows[1][2] == "5 handshakes agreed, 2 refused: expired"


def upstream_told(**links: object) -> dict[str, object]:
    link = {"state": "up", "in_flight": 1, "queued": 2, "suspended": [], **links}
    counters = {"forwarded": 7, "answered": 4, "shared": 0}
    return {"name": "hall", "endpoint": "rtu:///dev/ttyUSB0", "links": [link], "counters": counters}


@pytest.mark.parametrize(("pause", "words"), [(1.2, "in 1.2 s"), (None, "with the next request")])
def test_why_a_line_cannot_be_reached_is_shown_with_its_indicator_and_the_next_attempt(
    pause: float | None, words: str
) -> None:
    line = upstream_told(state="backing off", reason="/dev/ttyUSB0 cannot be opened", next_attempt=pause)
    line["indicators"] = {"communication": "off", "error": "flashing", "device_status": "off"}
    *_, table, down = sections_of(told(upstreams=[line]))
    assert table.rows[0][table.columns.index("error")] == "flashing"
    assert table.style_of(table.columns.index("error"), "flashing") == "yellow"
    assert (down.title, down.rows) == (
        "cannot be reached",
        [["hall", "/dev/ttyUSB0 cannot be opened", f"tried again {words}"]],
    )


def test_units_that_owe_replies_are_shown_in_a_section_of_their_own() -> None:
    *_, doubtful = sections_of(told(upstreams=[upstream_told(in_doubt=[3])]))
    assert (doubtful.title, doubtful.rows) == (
        "in doubt",
        [["hall", "unit 3", "owes a reply", "is asked behind a marker"]],
    )


def test_the_listeners_of_a_gateway_are_shown_as_servers_and_its_lines_as_a_table() -> None:
    server = {"supported_connections": 5, "connections": [{"peer": "10.0.0.9:1"}]}
    listener = {"name": "office", "server": server, "counters": {"no_route": 3, "own": 0}}
    sections = sections_of(told(gateway_listeners=[listener], upstreams=[upstream_told()]))
    titles = [section.title for section in sections]
    assert "listener office" in titles
    assert "1 remote connection of 5 supported" in titles
    assert next(section.rows for section in sections if section.title == "of them") == [["no route", "3"]]
    assert sections[-1].columns == ["upstream", "url", "state", "in flight", "queued", "forwarded", "answered"]
    assert sections[-1].rows == [["hall", "rtu:///dev/ttyUSB0", "up", "1", "2", "7", "4"]]
    assert list_of_programs([told(gateway_listeners=[listener])]).rows[0][4] == "1"


def test_units_of_a_line_that_are_not_asked_are_named_with_the_time_of_the_next_attempt() -> None:
    suspended = [
        {"unit": 9, "state": "open", "next_probe": 2.25},
        {"unit": 12, "state": "open", "next_probe": 0.0},
    ]
    sections = sections_of(told(upstreams=[upstream_told(state="suspect", suspended=suspended)]))
    assert sections[-1].title == "not asked now"
    assert sections[-1].rows == [
        ["hall", "unit 9", "does not answer", "asked again in 2.2 s"],
        ["hall", "unit 12", "does not answer", "asked again with the next request"],
    ]


def test_several_programs_are_a_line_each() -> None:
    section = list_of_programs([told(), told(running=False, uptime=0.0, endpoints=[])])
    assert section.rows == [
        ["4711", "plant", "running", "61 s", "0", "tcp://10.0.0.1:502"],
        ["4711", "plant", "stopped", "0.0 s", "0", ""],
    ]
