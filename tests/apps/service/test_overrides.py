"""Command-line overrides: for each option, whether the command line or the file counts."""

import pytest

from busway.apps.service.configuration import parse_configuration
from busway.apps.service.overrides import Overrides
from busway.options.networks import Networks

UNIT = "[[unit]]\nunit = 1\nholding_registers = 1\n"
FULL = parse_configuration(
    'listen = ["tcp://127.0.0.1:0"]\n[server]\npriority = ["10.0.0.1"]\n[audit]\npath = "a.jsonl"\n'
    '[metrics]\nlisten = "127.0.0.1:9502"\n[control]\npath = "a.sock"\n' + UNIT,
    "plant.toml",
)
PLAIN = parse_configuration(UNIT, "plain.toml")
QUIET = parse_configuration("[control]\nenabled = false\n" + UNIT, "quiet.toml")


def test_without_options_the_file_counts() -> None:
    none = Overrides()
    assert none.listeners_of(FULL) == list(FULL.listeners)
    assert (none.audit_at(FULL), none.metrics_at(FULL), none.control_at(FULL)) == (
        "a.jsonl",
        "127.0.0.1:9502",
        "a.sock",
    )
    assert (none.audit_at(PLAIN), none.metrics_at(PLAIN), none.control_at(PLAIN)) == (None, None, None)
    assert (none.listener_options, none.server_options) == ({}, {})


def test_each_option_of_the_command_line_goes_before_the_file() -> None:
    given = Overrides(listen=["udp://127.0.0.1:0"], audit="b", metrics="h:1", control="b.sock", standard_port=False)
    (listener,) = given.listeners_of(FULL)
    assert (listener.endpoint, listener.limits, listener.access) == ("udp://127.0.0.1:0", None, None)
    assert (given.audit_at(FULL), given.metrics_at(FULL), given.control_at(FULL)) == ("b", "h:1", "b.sock")
    assert given.server_options == {"standard_port": False}


def test_a_control_socket_that_the_file_switches_off_can_be_opened_by_the_command_line() -> None:
    assert Overrides().control_at(QUIET) == "off"
    assert Overrides(control="b.sock").control_at(QUIET) == "b.sock"
    assert Overrides(control="off").control_at(FULL) == "off"


def test_priority_replaces_the_priority_hosts_of_every_listener_when_the_file_is_read() -> None:
    given = Overrides(priority=Networks(["10.0.0.9"]))
    text = '[server]\npriority = ["10.0.0.1"]\n[[listener]]\nurl = "tcp://127.0.0.1:0"\npriority = ["10.0.0.2"]\n'
    read = parse_configuration(text + UNIT, "x.toml", changes=given.listener_options)
    (listener,) = given.listeners_of(read)
    assert listener.limits is not None
    assert listener.limits.priority == read.limits.priority == Networks(["10.0.0.9"])


@pytest.mark.parametrize("priority", [None, Networks(["10.0.0.9"])])
def test_priority_is_no_option_of_the_whole_server(priority: Networks | None) -> None:
    assert Overrides(priority=priority).server_options == {}
