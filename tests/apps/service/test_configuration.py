"""The object of a configuration: what each component gets from it, and what it gives programs."""

import tomllib
from pathlib import Path

import pytest

import busway
from busway.access.addresses import AddressList
from busway.apps.service.configuration import load_configuration, parse_configuration
from busway.apps.service.effective import effective
from busway.apps.service.overview import overview
from busway.client.settings import link_settings
from busway.config.certificates import tls_of
from busway.config.files.file_error import FileError
from busway.options.client import Hold
from busway.options.server import Scope
from busway.options.tls import TlsVersion
from busway.server.device import Device

SYSTEM = (Path(__file__).parents[2] / "config" / "files" / "system.toml").read_text(encoding="utf-8")
UNIT = "[[unit]]\nunit = 1\nholding_registers = [7, 8, 9]\n"


@pytest.mark.clause("T33")
def test_what_stands_with_a_listener_goes_before_what_holds_for_all() -> None:
    plain, own, secure, datagrams, line = parse_configuration(SYSTEM, "system.toml").listeners
    assert (plain.limits, plain.access, plain.tls) == (None, AddressList(), None)  # as the server has it
    assert own.limits is not None
    assert (own.limits.max_connections, own.limits.max_priority_connections, own.limits.frame_timeout) == (5, 4, None)
    assert isinstance(own.access, AddressList)
    assert (own.access("127.0.0.1"), own.access("127.0.0.9"), own.access("10.0.0.1")) == (True, False, False)
    assert secure.tls is not None
    assert (secure.tls.certificate, secure.tls.authority, secure.tls.require_role) == ("other.pem", "ca.pem", True)
    assert secure.tls.minimum_version is TlsVersion.TLS_1_3
    assert datagrams.limits is not None
    assert datagrams.limits.request_rate == 10.0
    assert line.limits is None


@pytest.mark.clause("T33")
def test_an_option_of_a_link_or_its_url_goes_before_those_of_all_links() -> None:
    links = parse_configuration(SYSTEM, "system.toml").links
    boiler, vault, line = (links[name].settings for name in ("boiler", "vault", "line"))
    assert (boiler.parameters.timeout, boiler.parameters.retries, boiler.parameters.max_transactions) == (0.5, 0, 4)
    assert (boiler.management.hold, vault.management.hold) == (60.0, Hold.REQUEST)
    assert vault.security is not None
    assert (vault.security.certificate, vault.security.server_name) == ("host.pem", "vault.example")
    assert line.line is not None
    assert line.line.port is not None
    assert (line.line.port.baud, line.parameters.retries, line.parameters.request_gap) == (19200, 2, 0.01)


def test_paths_in_urls_are_relative_to_the_folder_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    url = "tls://127.0.0.1:8020?certificate=own.pem&authority=/etc/ca.pem"
    general = '[security]\ncertificate = "host.pem"\nkey = "host.key"\nauthority = "all.pem"\n'
    links = f'[[link]]\nname = "a"\nurl = "{url}"\n'
    file.write_text(f'listen = ["{url}", "{url.replace("8020", "8021")}"]\n{general}{links}{UNIT}', encoding="utf-8")
    configuration = load_configuration(file)
    link = configuration.links["a"]
    found = [link.settings.security, *(tls_of(listener) for listener in configuration.listeners)]
    assert [(each and each.certificate, each and each.authority) for each in found] == [
        (str(tmp_path / "own.pem"), "/etc/ca.pem")
    ] * 3
    assert link_settings(link.url, link.options) == link.settings


def test_paths_are_relative_to_the_folder_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(SYSTEM, encoding="utf-8")
    configuration = load_configuration(file)
    assert configuration.audit == str(tmp_path / "audit.jsonl")
    assert configuration.control == str(tmp_path / "busway.sock")
    tls = configuration.listeners[2].tls
    assert tls is not None
    assert tls.key == str(tmp_path / "other.key")
    assert configuration.links["vault"].options["authority"] == str(tmp_path / "ca.pem")
    outside = parse_configuration(UNIT + '[audit]\npath = "/var/log/a.jsonl"\n', str(file))
    assert outside.audit == "/var/log/a.jsonl"


def test_an_address_of_loopback_for_the_control_socket_is_no_path() -> None:
    for text in ("127.0.0.1:0", "http://127.0.0.1:4711"):
        assert parse_configuration(UNIT + f'[control]\npath = "{text}"\n', "a/b.toml").control == text
    assert parse_configuration(UNIT, "a/b.toml").control is None


@pytest.mark.clause("T33")
async def test_a_program_serves_and_asks_by_the_same_file(tmp_path: Path) -> None:
    served = parse_configuration('listen = ["tcp://127.0.0.1:0"]\n[server]\nscope = "server"\n' + UNIT, "x.toml")
    assert served.served()["scope"] == Scope.SERVER.value
    async with served.serve() as server:
        file = tmp_path / "client.toml"
        file.write_text(f'[[link]]\nname = "boiler"\nurl = "{server.endpoints[0]}"\ntimeout = 2\n')
        async with busway.load_configuration(file).open("boiler", shared=False) as link:
            assert await link.unit(1).read_holding_registers(0, count=3) == [7, 8, 9]


def test_a_blocking_program_gets_its_link_by_name(tmp_path: Path) -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: Device(holding_registers=[5])}) as server:
        text = f'[client]\nretries = 0\n[[link]]\nname = "a"\nurl = "{server.endpoints[0]}"\n'
        with parse_configuration(text, "x.toml").connect("a") as link:
            assert link.unit(1).read_holding_registers(0, count=1) == [5]


def test_a_name_that_there_is_not_is_refused_with_those_there_are() -> None:
    configuration = parse_configuration(SYSTEM, "system.toml")
    with pytest.raises(busway.ConfigError, match=r"no link 'boilers'; there are boiler, vault, line"):
        configuration.link("boilers")
    with pytest.raises(busway.ConfigError, match=r"no link 'a'; there is none"):
        parse_configuration(UNIT, "x.toml").connect("a")


def test_what_has_no_unit_cannot_be_served() -> None:
    with pytest.raises(busway.ConfigError, match="there is no unit to serve"):
        parse_configuration('[[link]]\nname = "a"\nurl = "tcp://h"\n', "x.toml").serve()


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(busway.ConfigError, match=r"nothing\.toml: cannot be read: no such file"):
        busway.load_configuration(tmp_path / "nothing.toml")


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("[simulation]\nseed = 1\n[[unit]]\nunit = 1\n", "plant.toml:1: simulation"),
        ('[[include]]\nfile = "x.toml"\nsurprise = 1\n', "plant.toml:1: include"),
        ("[[unit]]\nunit = 1\nholes = 0\n", "plant.toml:3: unit[0].holes"),
        (
            '[[unit]]\nunit = 1\n[[unit.point]]\nname = "a"\naddress = "4x1"\nbehaviour = { kind = "noise" }\n',
            "plant.toml:6: unit[0].point[0].behaviour",
        ),
    ],
)
def test_a_simulation_file_is_told_from_others_with_what_reads_it(text: str, place: str) -> None:
    with pytest.raises(FileError) as caught:
        parse_configuration(text, "plant.toml")
    sentence = "only simulation files have this; such a file is read by: busway simulate plant.toml --check"
    assert str(caught.value) == f"{place}: {sentence}"


def test_what_a_point_can_say_is_no_mark_of_a_simulation_file() -> None:
    text = '[[unit]]\nunit = 1\n[[unit.point]]\nname = "a"\naddress = "4x1"\nmaximum = 1\nenumeration = { off = 0 }\n'
    (unit,) = parse_configuration(text, "plant.toml").file.unit
    assert (unit.point[0].maximum, unit.point[0].enumeration) == (1.0, {"off": 0})


def test_a_key_that_no_file_has_is_no_mark_of_a_simulation_file() -> None:
    with pytest.raises(FileError, match="unknown key"):
        parse_configuration("[[unit]]\nunit = 1\nbehaviour = 0\n", "plant.toml")


def test_the_check_opens_the_files_that_are_named(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(SYSTEM.replace("audit.jsonl", "there/is/none/audit.jsonl"), encoding="utf-8")
    (tmp_path / "ca.pem").write_text("no certificate")
    with pytest.raises(FileError) as caught:
        load_configuration(file, preflight=True)
    said = str(caught.value).splitlines()
    assert [sentence.split(": ")[1] for sentence in said] == [
        "listener[1].certificate",
        "listener[1].key",
        "security.certificate",
        "security.key",
        "audit.path",
    ]
    assert said[0].endswith(f"{tmp_path / 'other.pem'} cannot be read: no such file or directory")


def test_the_check_tries_whether_certificates_can_be_used(tmp_path: Path) -> None:
    for name in ("host.pem", "host.key", "ca.pem"):
        (tmp_path / name).write_text("no certificate")
    file = tmp_path / "plant.toml"
    file.write_text(
        '[[listener]]\nurl = "tls://127.0.0.1:0"\n'
        f'[security]\ncertificate = "host.pem"\nkey = "host.key"\nauthority = "ca.pem"\n{UNIT}'
    )
    load_configuration(file)  # not examined
    with pytest.raises(FileError, match=r"plant\.toml:4: security\.certificate: .*host\.pem: there is no"):
        load_configuration(file, preflight=True)


def test_changes_go_before_what_the_file_says() -> None:
    configuration = parse_configuration(SYSTEM, "x.toml", changes={"max_connections": 7})
    own = configuration.listeners[1].limits
    assert own is not None
    assert (own.max_connections, configuration.limits.max_connections) == (7, 7)
    assert configuration.served()["max_connections"] == 7


def test_the_effective_values_are_a_file_that_says_the_same() -> None:
    configuration = parse_configuration(SYSTEM, "x.toml")
    lines = list(effective(configuration, tomllib.loads(SYSTEM)))
    assert "write_timeout = 30.0" in lines
    assert "backlog = 1024" in lines
    text = "\n".join(lines)
    again = parse_configuration(text, "x.toml")
    assert list(effective(again, tomllib.loads(text))) == lines
    assert again.limits == configuration.limits
    for name, link in configuration.links.items():
        assert again.links[name].settings.differs(link.settings) == ""


def test_the_effective_values_have_the_certificates_of_a_url_as_keys() -> None:
    text = (
        '[security]\ncertificate = "host.pem"\nkey = "host.key"\nauthority = "ca.pem"\n'
        '[[listener]]\nurl = "tls://127.0.0.1:8020?certificate=own.pem&key=own.key"\nmax_handshakes = 8\n' + UNIT
    )
    configuration = parse_configuration(text, "x.toml")
    lines = list(effective(configuration, tomllib.loads(text)))
    assert 'url = "tls://127.0.0.1:8020"' in lines
    assert 'certificate = "own.pem"' in lines
    again = "\n".join(lines)
    (listener,) = parse_configuration(again, "x.toml").listeners
    assert tls_of(listener) == tls_of(configuration.listeners[0])
    assert list(effective(parse_configuration(again, "x.toml"), tomllib.loads(again))) == lines


def test_the_overview_has_a_row_for_everything() -> None:
    rows = {(kind, name): said for kind, name, said in overview(parse_configuration(SYSTEM, "x.toml"))}
    own = rows["listener", "tcp://127.0.0.1:5021"]
    assert own.startswith("allows 127.0.0.0/8; denies 127.0.0.9; refuses all others; 4 priority slots for 10.0.0.1")
    assert "a role is required" in rows["listener", "tls://127.0.0.1:0"]
    assert rows["policy", ""] == (
        "2 rules (setpoints, rule 2), else read-only; "
        "allows 10.0.0.0/8, 127.0.0.1; denies 10.9.0.0/16; refuses all others"
    )
    assert rows["server", ""] == "audit audit.jsonl; metrics on 127.0.0.1:9502; control socket busway.sock"
    assert rows["link", "boiler"] == (
        "tcp://10.0.0.5?retries=0; timeout 0.5, deadline none, keepalive_idle 30, hold 60.0, max_transactions 4"
    )
    assert rows["unit", "2"] == "100 holding registers, 1 point"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "none: a client that may connect may do everything"),
        (
            'listen = ["tcp://10.0.0.1:5020"]\n',
            "none: a client that may connect may do everything; the command makes what the network reaches read-only",
        ),
        ('policy = "read-only"\n', "read-only"),
        (
            '[policy]\ndefault = "deny"\nallow = ["10.0.0.0/8"]\n[[policy.rule]]\nname = "x"\n',
            "1 rule (x), else deny; allows 10.0.0.0/8; refuses all others",
        ),
    ],
)
def test_the_overview_says_what_becomes_of_requests_and_who_may_connect(text: str, said: str) -> None:
    rows = {(kind, name): told for kind, name, told in overview(parse_configuration(text + UNIT, "x.toml"))}
    assert rows["policy", ""] == said
