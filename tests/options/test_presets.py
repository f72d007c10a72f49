"""The preset ``strict``: every must where a default of ours deviates, and nothing that contradicts it."""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import busway
from busway.client.settings import link_settings, options_of
from busway.config.files.device import parse_device_file
from busway.errors import ConfigError
from busway.options.accepted_options import LINKS, LISTENERS, SERVERS, AcceptedOptions
from busway.options.client import MismatchPolicy, TransactionScope
from busway.options.endpoints import parse_endpoint
from busway.options.presets import PASSIVE_SETTINGS, Preset, preset_of, strict_settings
from busway.options.server import ListenerParameters, Scope, UnitPolicy, UnlistedUnit
from busway.options.tls import TlsParameters
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.server.listener import Listener
from busway.server.listener_settings import listener_settings

ROOT = Path(__file__).resolve().parents[2]
DATA: dict[str, Any] = tomllib.loads((ROOT / "docs" / "conformance.toml").read_text(encoding="utf-8"))
STRICT_LINKS = strict_settings(AcceptedOptions.of(*LINKS).options)
STRICT_SERVERS = strict_settings(AcceptedOptions.of(*SERVERS).options)
STRICT_LISTENERS = strict_settings(AcceptedOptions.of(*LISTENERS).options)
EVERYWHERE = STRICT_LINKS | STRICT_LISTENERS | STRICT_SERVERS
TLS = TlsParameters(certificate="server.pem", authority="ca.pem")
URLS = ("tcp://h", "udp://h", "rtu:///dev/x", "ascii:///dev/x", "rtu+tcp://h:1", "ascii+udp://h:1")


def settings_in(parts: object) -> Iterator[tuple[str, object]]:
    """Every option of a link, by name."""
    for name in getattr(type(parts), "__slots__", ()):
        value = getattr(parts, name)
        if hasattr(type(value), "__slots__") and hasattr(type(value), "__dataclass_fields__"):
            yield from settings_in(value)
        else:
            yield name, value


@pytest.mark.clause("S21")
@pytest.mark.parametrize("deviation", DATA["deviation"], ids=lambda one: str(one["clause"])[:12])
def test_every_deviation_that_an_option_ends_is_ended_by_the_preset(deviation: dict[str, Any]) -> None:
    assert ("preset" in deviation) != (deviation["option"] == "none"), "an option ends it, so the preset has to"
    for option in deviation.get("preset", ()):
        assert option in EVERYWHERE
        assert f"`{option}" in deviation["option"]


@pytest.mark.clause("S21")
def test_whatever_the_preset_changes_is_stated_as_a_deviation() -> None:
    stated = {option for one in DATA["deviation"] for option in one.get("preset", ())}
    defaults = {**dict(settings_in(link_settings("tcp://h", {})))}
    for url in URLS:
        defaults |= dict(settings_in(link_settings(url, {})))
    changed = set()
    for option, setting in STRICT_LINKS.items():
        default = defaults.get(option, setting.value)
        if getattr(default, "value", default) != setting.value:
            changed.add(option)
    assert changed <= stated
    assert "require_purpose" in stated
    assert set(STRICT_SERVERS) - stated <= {"keepalive", "no_delay"}  # those are our defaults


@pytest.mark.clause("S21")
@pytest.mark.parametrize("url", URLS)
def test_a_link_has_every_setting_of_the_preset_that_its_scheme_has(url: str) -> None:
    plain, strict = (dict(settings_in(link_settings(url, options))) for options in ({}, {"preset": "strict"}))
    in_url = dict(settings_in(link_settings(f"{url}?preset=strict", {})))
    assert {**in_url, "endpoint": None, "options": None} == {**strict, "endpoint": None, "options": None}
    for option, setting in STRICT_LINKS.items():
        refused = False
        try:
            link_settings(url, {option: setting.value})
        except ConfigError:
            refused = True  # its scheme does not have it
        if refused:
            assert strict.get(option) == plain.get(option)
        else:
            value = strict[option]
            assert getattr(value, "value", value) == setting.value, option


@pytest.mark.clause("S21")
@pytest.mark.parametrize(
    ("url", "option", "value"),
    [
        ("tcp://h", "single_adu_segments", False),
        ("tcp://h", "unit_policy", "ignore"),
        ("tcp://h", "transaction_policy", MismatchPolicy.AUTOMATIC),
        ("tcp://h", "scope", "connection"),
        ("tcp://h", "keepalive", "off"),
        ("rtu:///dev/x", "strict_timing", "off"),
        ("rtu:///dev/x", "mark_errors", False),
        ("rtu:///dev/x", "stop_bits", 2),
        ("ascii:///dev/x", "upper_case_only", False),
        ("ascii:///dev/x", "data_bits", "8"),
    ],
)
def test_an_option_that_contradicts_the_preset_is_refused_by_name(url: str, option: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f"{option}: does not go with the preset strict, which needs"):
        link_settings(url, {"preset": "strict", option: value})
    link_settings(url, {"preset": "standard", option: value})


@pytest.mark.clause("S21")
def test_what_agrees_with_the_preset_or_is_left_to_the_user_may_be_given_beside_it() -> None:
    settings = link_settings(
        "tcp://h?preset=STRICT&single_adu_segments=yes", {"connect_timeout": 2, "unit_policy": "strict"}
    )
    assert settings.parameters.single_adu_segments
    assert settings.sockets.connect_timeout == 2.0
    assert settings.sockets.keepalive_idle == 7200
    assert settings.parameters.scope is TransactionScope.CLIENT
    line = link_settings("rtu:///dev/x?parity=none&stop_bits=2", {"preset": Preset.STRICT}).line
    assert line is not None
    assert line.framing.strict_timing


def test_a_preset_that_is_not_there_is_refused() -> None:
    with pytest.raises(ConfigError, match="preset: must be one of standard, strict, passive, not 'lax'"):
        link_settings("tcp://h?preset=lax", {})
    with pytest.raises(ConfigError, match="preset: must be one of"):
        busway.serve(units=Device(coils=1), preset="lax")
    assert preset_of(None) is Preset.STANDARD


def test_the_reference_lists_every_setting_of_the_preset() -> None:
    page = (ROOT / "docs" / "reference" / "defaults.md").read_text(encoding="utf-8")
    for option, setting in (*STRICT_LINKS.items(), *STRICT_LISTENERS.items(), *STRICT_SERVERS.items()):
        value = "on" if setting.value is True else setting.value
        shown = f"`{option}={value:g}`" if isinstance(value, int | float) else f"`{option}={value}`"
        assert f"{shown}*" in page if setting.adaptable else shown in page, setting.option


# Servers.


@pytest.mark.clause("S21")
def test_a_strict_server_has_every_setting_of_the_preset() -> None:
    server = busway.serve(
        "tcp://127.0.0.1:5020", "rtu:///dev/x", units={1: Device(coils=1)}, preset="strict", max_transactions=4
    )
    handler, parameters = server._responder, server._parameters
    assert isinstance(handler, DeviceResponder)
    assert handler._silent
    assert (parameters.scope, parameters.diagnostics_changes, parameters.max_transactions) == (Scope.SERVER, True, 4)
    sockets = server._sockets
    assert (sockets.keepalive_idle, sockets.keepalive_interval, sockets.keepalive_count) == (7200, 75, 8)
    assert [str(one.endpoint.url) for one in server._settings] == [
        "tcp://127.0.0.1:5020",
        "rtu:///dev/x",
        "tcp://127.0.0.1:502",
    ]
    assert all(one.limits.single_adu_segments for one in server._settings)
    assert server._settings[1].framing.strict_timing


@pytest.mark.clause("S21")
@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"unlisted": "exception"}, "unlisted"),
        ({"unlisted": UnlistedUnit.EXCEPTION}, "unlisted"),
        ({"scope": "connection"}, "scope"),
        ({"single_adu_segments": False}, "single_adu_segments"),
        ({"diagnostics_changes": False}, "diagnostics_changes"),
    ],
)
def test_a_strict_server_refuses_what_contradicts_it_by_name(options: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError, match=f"{key}: does not go with the preset strict"):
        busway.serve(units={1: Device(coils=1)}, preset="strict", **options)


@pytest.mark.clause("S21")
async def test_a_strict_server_and_a_strict_client_converse() -> None:
    device = Device(holding_registers=[7] * 10)
    strict: dict[str, Any] = {"preset": "strict", "standard_port": False}
    async with (
        busway.serve("tcp://127.0.0.1:0", units={1: device}, **strict) as server,
        busway.open(server.endpoints[0] + "?preset=strict", timeout=10, retries=0) as link,
    ):
        assert await link.unit(1).read_holding_registers(0, count=2) == [7, 7]
        await link.unit(1).write_multiple_registers(0, [1, 2])
        assert device.holding_registers[0:2] == [1, 2]
        assert await link.unit(1).diagnostics(0x0A) == b"\0\0"  # on network listeners only where that is switched on
        with pytest.raises(busway.NoReply):
            await link.unit(2).read_holding_registers(0, count=1, timeout=0.2)


def test_a_server_without_a_preset_is_as_it_was() -> None:
    server = busway.serve(units={1: Device(coils=1)}, unit_policy=UnitPolicy.LISTED)
    assert isinstance(server._responder, DeviceResponder)
    assert not server._responder._silent
    assert [one.endpoint.url for one in server._settings] == ["tcp://127.0.0.1:5020"]
    assert server._parameters.scope is Scope.CONNECTION


@pytest.mark.clause("S21")
def test_the_url_of_a_listener_on_a_line_takes_the_preset() -> None:
    def made(url: str) -> Any:
        return listener_settings(Listener(url), limits=ListenerParameters())

    assert made("rtu:///dev/x?preset=strict").framing.strict_timing
    assert made("ascii:///dev/x?preset=strict").framing.upper_case_only
    assert not made("rtu+tcp://:1?preset=strict").framing.strict_timing  # a network has no times between characters
    with pytest.raises(ConfigError, match="strict_timing: does not go with the preset"):
        made("rtu:///dev/x?preset=strict&strict_timing=off")
    with pytest.raises(ConfigError, match=r"unknown option .* there are none"):
        made("tcp://:1?preset=strict")  # of the server, not of one of its listeners


@pytest.mark.clause("S21")
@pytest.mark.parametrize("text", ['preset = "strict"', 'preset = "strict"\nunlisted = "silence"'])
def test_a_file_chooses_the_preset_of_its_server(text: str) -> None:
    file = parse_device_file(f"[server]\n{text}\n[[unit]]\nunit = 1\ncoils = 1\n", "plant.toml")
    assert file.server.options()["preset"] == "strict"
    assert "unit_policy" not in file.server.options()


# Port 502 beside others.


@pytest.mark.clause("T3")
@pytest.mark.parametrize(
    ("places", "expected"),
    [
        (["tcp://127.0.0.1:5020"], ["tcp://127.0.0.1:502"]),
        (["tcp://127.0.0.1:5020", "tcp://127.0.0.1:502"], []),
        (["tcp://127.0.0.1:5020", "tcp://:502"], []),
        (["tcp://127.0.0.1:5020", "tcp://127.0.0.1:5021", "tcp://[::1]:7"], ["tcp://127.0.0.1:502", "tcp://[::1]:502"]),
        (["udp://127.0.0.1:5020", "rtu:///dev/x", "tls://:802", "rtu+tcp://:4001"], []),
    ],
)
def test_502_is_listened_on_beside_another_port_once_for_each_host(places: list[str], expected: list[str]) -> None:
    server = busway.serve(*places, units={1: Device(coils=1)}, tls=TLS, standard_port="on")  # type: ignore[arg-type]
    assert [one.endpoint.url for one in server._settings[len(places) :]] == expected


@pytest.mark.clause("T3")
def test_a_strict_server_listens_on_502_unless_that_is_switched_off_by_name() -> None:
    units = {1: Device(coils=1)}
    for options, count in (({}, 2), ({"standard_port": False}, 1)):
        server = busway.serve("tcp://127.0.0.1:5020", units=units, preset="strict", **options)
        assert len(server._settings) == count
    assert len(busway.serve("tcp://127.0.0.1:5020", units=units, standard_port=True)._settings) == 2


@pytest.mark.clause("T3")
def test_the_listener_on_502_has_access_rules_and_limits_of_the_one_it_stands_beside() -> None:
    def refuse_all(host: str) -> bool:
        return False

    beside = Listener("tcp://127.0.0.1:5020", access=refuse_all, limits=ListenerParameters(max_connections=3))
    added = busway.serve(beside, units={1: Device(coils=1)}, preset="strict")._settings[1]
    assert added.access is refuse_all
    assert added.limits == ListenerParameters(max_connections=3, single_adu_segments=True)


@pytest.mark.parametrize("url", URLS)
def test_a_passive_client_repeats_and_recycles_nothing_on_every_scheme(url: str) -> None:
    found = dict(settings_in(link_settings(url, {"preset": "passive"})))
    known = options_of(parse_endpoint(url))
    there = {name: value for name, value in PASSIVE_SETTINGS.items() if name in known}
    assert {name: found.get(name, value) for name, value in there.items()} == there
    assert {"retries", "write_retries"} <= there.keys()


def test_a_passive_client_hardly_pauses_between_attempts_to_open_a_serial_port() -> None:
    found = dict(settings_in(link_settings("rtu:///dev/ttyUSB0?preset=passive", {})))
    assert (found["port_wait"], found["reopen_first"], found["reopen_most"]) == (0.0, 0.01, 0.01)


def test_options_beside_passive_replace_its_own() -> None:
    assert dict(settings_in(link_settings("tcp://h?preset=passive", {"retries": 2})))["retries"] == 2


def test_no_server_is_passive() -> None:
    with pytest.raises(ConfigError, match="passive is a preset of clients"):
        busway.serve("tcp://127.0.0.1:0", preset="passive")  # type: ignore[arg-type]
