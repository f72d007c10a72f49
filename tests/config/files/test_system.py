"""Configuration files: what they may say, what does not go together, and their JSON Schema."""

import random
import re
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from damaged_texts import after_accidents
from json_schema import faults

from busway.apps.service.configuration import Configuration, parse_configuration
from busway.client.settings import options_of
from busway.config.files.device import DeviceFile, ServerSection
from busway.config.files.file_error import FileError
from busway.config.files.listeners import ListenerSection
from busway.config.files.section import Section, json_schema
from busway.config.files.system import (
    AuditSection,
    ClientSection,
    LinkSection,
    MetricsSection,
    SecuritySection,
    SystemFile,
)
from busway.errors import ConfigError
from busway.options.accepted_options import options_for
from busway.options.endpoints import SCHEMES, parse_endpoint
from busway.options.server import ListenerParameters, ServerParameters
from busway.options.sockets import SocketParameters
from busway.options.tls import TlsParameters

FOLDER = Path(__file__).parent
SYSTEM = (FOLDER / "system.toml").read_text(encoding="utf-8")
DEVICES = (FOLDER / "good.toml").read_text(encoding="utf-8")
REFERENCE = Path(__file__).parents[3] / "docs" / "reference" / "configuration.md"
MUTATIONS = 200

UNIT = "[[unit]]\nunit = 1\n"


def test_a_section_that_no_file_has_costs_no_schema() -> None:
    class Seldom(Section):
        key: int

    assert not Seldom.__pydantic_complete__
    assert Seldom.model_validate({"key": 1}).key == 1
    assert Seldom.__pydantic_complete__


def test_sections_that_a_file_leaves_out_are_one_object_in_all_units() -> None:
    units = parse_configuration("[[unit]]\nunit = 1\ncoils = 1\n[[unit]]\nunit = 2\ncoils = 1\n", "two.toml").file.unit
    assert units[0].read is units[1].read


def problems_of(text: str) -> list[str]:
    """The sentences about a file that cannot be used."""
    with pytest.raises(FileError) as caught:
        parse_configuration(text, "x.toml")
    return str(caught.value).splitlines()


@pytest.mark.clause("T33")
def test_one_file_says_everything_about_server_client_and_security() -> None:
    file = parse_configuration(SYSTEM, "system.toml").file
    assert [url for _, url in file.places()][:2] == ["tcp://127.0.0.1:0", "tcp://127.0.0.1:5021"]
    assert file.server.options()["priority"] == ["10.0.0.1", "10.1.0.0/16"]
    assert file.security.options()["minimum_version"] == "1.3"
    assert file.client.options()["hold"] == "request"
    assert [link.name for link in file.link] == ["boiler", "vault", "line"]
    assert file.policy is not None
    assert file.policy.default == "read-only"
    assert (file.audit, file.metrics) == (
        AuditSection(path="audit.jsonl", interval=1, on_failure="refuse"),
        MetricsSection(listen="127.0.0.1:9502"),
    )
    assert file.control.path == "busway.sock"


@pytest.mark.clause("T33")
@pytest.mark.parametrize(
    ("url", "own", "baud"),
    [
        ("rtu:///dev/x?baud=9600", "", 9600),
        ("rtu:///dev/x?baudrate=9600", "", 9600),
        ("rtu:///dev/x?baudrate=9600", "baud = 9600", 9600),
        ("rtu:///dev/x", "", 19_200),
    ],
)
def test_an_option_of_a_url_goes_before_that_of_all_links_under_each_of_its_names(
    url: str, own: str, baud: int
) -> None:
    text = f'[client]\nbaud = 19200\n[[link]]\nname = "a"\nurl = "{url}"\n{own}\n'
    line = parse_configuration(text, "x.toml").links["a"].settings.line
    assert line is not None
    assert line.port is not None
    assert line.port.baud == baud


@pytest.mark.clause("T33")
def test_every_device_file_is_a_configuration_file() -> None:
    configuration = parse_configuration(DEVICES, "good.toml")
    assert [str(one.endpoint) for one in configuration.listeners] == ["tcp://127.0.0.1:0", "tcp://[::1]:0"]


def test_units_alone_are_served_on_the_usual_endpoint_and_links_alone_need_no_unit() -> None:
    assert [url for _, url in parse_configuration(UNIT, "x").file.places()] == ["tcp://127.0.0.1:5020"]
    links = parse_configuration('[[link]]\nname = "a"\nurl = "tcp://h"\n', "x")
    assert (links.listeners, list(links.links)) == ((), ["a"])


@pytest.mark.clause("T33")
@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "x.toml:1: unit: is missing"),
        ('listen = ["tcp://:0"]\n[[link]]\nname = "a"\nurl = "tcp://h"\n', "x.toml:1: unit: is missing"),
        (UNIT + '[[listener]]\nurl = "nowhere"\n', "x.toml:4: listener[0].url: 'nowhere' is no endpoint"),
        (UNIT + "[[listener]]\n", "x.toml:3: listener[0].url: is missing"),
        (
            UNIT + '[[listener]]\nurl = "tcp://h"\nalow = []\n',
            "x.toml:5: listener[0].alow: unknown key; is it",
        ),
        (
            UNIT + '[[listener]]\nurl = "tcp://h"\nallow = ["10.0.0.1/8"]\n',
            "x.toml:5: listener[0].allow: '10.0.0.1/8' has bits set beyond",
        ),
        (
            UNIT + '[[listener]]\nurl = "tcp://h"\nmax_per_host = 99\n',
            "x.toml:5: listener[0].max_per_host: does not fit max_connections, which is 56",
        ),
        (
            UNIT + '[server]\nmax_per_host = 9\n[[listener]]\nurl = "tcp://h"\nmax_connections = 5\n',
            "x.toml:4: server.max_per_host: does not fit max_connections, which is 5",
        ),
        (UNIT + "[server]\nidle_timeout = 0\n", "x.toml:4: server.idle_timeout: must be 0.001…"),
        (UNIT + '[server]\nidle_timeout = "never"\n', "x.toml:4: server.idle_timeout: must be a number, not 'never'"),
        (UNIT + '[[listener]]\nurl = "rtu:///dev/x"\nallow = []\n', "x.toml:5: listener[0].allow: has no effect on a"),
        (
            UNIT + '[[listener]]\nurl = "udp://h"\nidle_timeout = 5\nrequest_rate = 5\n',
            "x.toml:5: listener[0].idle_timeout: has no effect on a udp:// listener",
        ),
        (
            UNIT + '[[listener]]\nurl = "rtu+tcp://h:1"\nidle_timeout = 5\nframe_timeout = 5\n',
            "x.toml:6: listener[0].frame_timeout: has no effect on a rtu+tcp:// listener",
        ),
        (UNIT + '[[listener]]\nurl = "tcp://h"\nallow = []\n', "x.toml:5: listener[0].allow: is empty: leave it out"),
        (UNIT + '[[listener]]\nurl = "tcp://h"\nkey = "k"\n', "x.toml:5: listener[0].key: is for tls:// listeners"),
        (UNIT + '[[listener]]\nurl = "tls://h"\n', "x.toml:3: listener[0]: a tls:// listener needs a certificate"),
        (UNIT + '[[listener]]\nurl = "tcp://h?baud=1"\n', "x.toml:4: listener[0].url: unknown option of a listener"),
        (
            UNIT + '[security]\nkey = "k"\n',
            "x.toml:3: security.certificate: there is a key, but no certificate",
        ),
        (
            'listen = ["tcp://:502"]\n' + UNIT + '[[listener]]\nurl = "tls://10.0.0.1:502"\n',
            "x.toml:5: listener[0].url: tls://10.0.0.1:502 is taken by tcp://:502",
        ),
        ('listen = ["tcp://h:1",\n"tcp://h:1"]\n' + UNIT, "x.toml:2: listen[1]: tcp://h:1 is taken by tcp://h:1"),
        (UNIT + UNIT, "x.toml:4: unit[1].unit: unit 1 is there already: unit[0]"),
        ("[client]\ntimeout = 0\n" + UNIT, "x.toml:2: client.timeout: must be 0.001…3600, not 0"),
        (
            '[client]\nhold = "long"\n' + UNIT,
            "x.toml:2: client.hold: must be 0.01…86400, forever or request, not 'long'",
        ),
        (
            '[[link]]\nname = "a"\nurl = "tcp://h"\nbaud = 1\n',
            "x.toml:4: link[0].baud: unknown option of",
        ),
        ('[[link]]\nname = "a"\nurl = "tcp://h?retries=-1"\n', "x.toml:3: link[0].url: must be 0…100"),
        (
            '[client]\nmax_transactions = 4\n[[link]]\nname = "a"\nurl = "tcp://h"\ntransaction_policy = "ignore"\n',
            "x.toml:6: link[0].transaction_policy: ignore goes with max_transactions 1 only",
        ),
        (
            '[[link]]\nname = "a"\nurl = "tcp://h?timeout=1"\ntimeout = 2\n',
            "x.toml:4: link[0].timeout: has another value in url (?timeout=): leave one of the two out",
        ),
        (
            '[[link]]\nname = "a"\nurl = "rtu:///dev/x?baudrate=9600"\nbaud = 4800\n',
            "x.toml:4: link[0].baud: has another value in url (?baudrate=): leave one of the two out",
        ),
        (
            '[[link]]\nname = "a"\nurl = "tcp://h?timeout=soon"\ntimeout = 2\n',
            "x.toml:4: link[0].timeout: has another value in url (?timeout=): leave one of the two out",
        ),
        (
            '[[link]]\nname = "a"\nurl = "tcp://h?preset=passive"\npreset = "strict"\n',
            "x.toml:4: link[0].preset: has another value in url (?preset=): leave one of the two out",
        ),
        (
            UNIT + '[[listener]]\nurl = "tls://h?certificate=u.pem"\ncertificate = "s.pem"\n',
            "x.toml:5: listener[0].certificate: has another value in url (?certificate=): leave one of the two out",
        ),
        (
            '[[link]]\nname = "a"\nurl = "tcp://h"\n' * 2,
            "x.toml:5: link[1].name: 'a' is there already: link[0]",
        ),
        (
            '[[client.link]]\nname = "a"\nurl = "tcp://h"\n',
            "x.toml:1: client.link: unknown key; the keys allowed here are preset, timeout",
        ),
        ('[[link]]\nname = ""\nurl = "tcp://h"\n', "x.toml:2: link[0].name: "),
        ('[[link]]\nname = "a"\nurl = "tls://h"\n', "x.toml:1: link[0]: the authority that the server's"),
        (UNIT + '[policy]\ndefault = "some"\n', "x.toml:4: policy.default: must be 'allow', 'deny' or 'read-only'"),
        (UNIT + '[policy]\ndefault = "deny"\n[[policy.rule]]\nunits = 300\n', "x.toml:6: policy.rule[0].units: "),
        (UNIT + "[audit]\n", "x.toml:3: audit.path: is missing"),
        (
            UNIT + '[metrics]\nlisten = "9502"\n',
            "x.toml:4: metrics.listen: an address such as 127.0.0.1:9502 is needed, not '9502'",
        ),
        (
            UNIT + '[metrics]\nlisten = "h:70000"\n',
            "x.toml:4: metrics.listen: an address such as 127.0.0.1:9502 is needed; a port is 0…65535, not 70000",
        ),
        (UNIT + '[control]\nenabled = "no"\n', "x.toml:4: control.enabled: must be true or false, not 'no'"),
    ],
)
def test_what_cannot_be_is_said_with_its_line_and_key(text: str, sentence: str) -> None:
    assert sentence in "\n".join(problems_of(text))


@pytest.mark.clause("T33")
@pytest.mark.parametrize(
    ("url", "own"),
    [
        ("tcp://h?timeout=2.0", "timeout = 2"),
        ("tcp://h?deadline=none", 'deadline = "none"'),
        ("tcp://h?hold=request", 'hold = "request"'),
        ("tcp://h?preset=Strict", 'preset = "strict"'),
        ("rtu:///dev/x?baudrate=9600", "baud = 9600"),
        ("tls://h?authority=ca.pem", 'authority = "ca.pem"'),
    ],
)
def test_an_option_may_stand_in_a_link_and_in_its_url_with_the_same_value(url: str, own: str) -> None:
    assert "a" in parse_configuration(f'[[link]]\nname = "a"\nurl = "{url}"\n{own}\n', "x.toml").links


@pytest.mark.clause("T33")
def test_an_option_may_stand_in_a_listener_and_in_its_url_with_the_same_value() -> None:
    text = UNIT + '[[listener]]\nurl = "tls://h?certificate=a&authority=b"\ncertificate = "a"\n'
    (listener,) = parse_configuration(text, "x.toml").listeners
    assert listener.tls is not None
    assert listener.tls.certificate == "a"


@pytest.mark.clause("T33")
def test_each_option_that_differs_from_its_url_is_said() -> None:
    text = UNIT + '[[listener]]\nurl = "tls://h?certificate=a&key=b&authority=c"\ncertificate = "d"\nkey = "e"\n'
    assert [sentence.split(": ")[1] for sentence in problems_of(text)] == ["listener[0].certificate", "listener[0].key"]


@pytest.mark.clause("T33")
def test_all_that_components_refuse_is_said_at_once_in_the_order_of_the_lines() -> None:
    text = (
        '[[listener]]\nurl = "tls://h"\nallow = ["x"]\n[[link]]\nname = "a"\nurl = "tcp://h?queue=0"\n'
        "[server]\nrequest_rate = 0\n" + UNIT
    )
    assert [sentence.split(": ")[0] for sentence in problems_of(text)] == [f"x.toml:{n}" for n in (1, 3, 6, 8)]


def test_each_number_of_a_section_that_is_out_of_range_is_said_beside_its_other_faults() -> None:
    early = "[server]\nmax_transactions = 17\nkeepalive_idle = 0\n[client]\nretries = 500\nqueue = 0\n"
    assert [sentence.split(": ")[1] for sentence in problems_of(early + UNIT)] == [
        "server.max_transactions",
        "server.keepalive_idle",
        "client.retries",
        "client.queue",
    ]
    later = "[server]\nbacklog = 0\nidle_timeout = -1\n[[link]]\nname = 'a'\nurl = 'tcp://h'\nqueue = 0\nretries = -1\n"
    assert [sentence.split(": ")[1] for sentence in problems_of(later + UNIT)] == [
        "server.backlog",
        "server.idle_timeout",
        "link[0].queue",
        "link[0].retries",
    ]


@pytest.mark.parametrize(
    ("one", "other", "clash"),
    [
        ("tcp://:502", "tcp://:502", True),
        ("tcp://0.0.0.0:502", "tls://10.0.0.1:502", True),
        ("tcp://10.0.0.1:502", "tcp://:502", True),
        ("tcp://localhost:502", "tcp://127.0.0.1:502", True),
        ("tcp://[::]:502", "tcp://[::1]:502", True),
        ("tcp://0.0.0.0:502", "tcp://[::]:502", False),
        ("tcp://10.0.0.1:502", "tcp://10.0.0.2:502", False),
        ("tcp://:502", "udp://:502", False),
        ("tcp://:502", "tcp://:503", False),
        ("tcp://127.0.0.1:0", "tcp://127.0.0.1:0", False),
        ("rtu:///dev/a", "ascii:///dev/a", True),
        ("rtu:///dev/a", "rtu:///dev/b", False),
    ],
)
def test_two_listeners_on_one_address_are_found(one: str, other: str, clash: bool) -> None:
    text = '[security]\ncertificate = "c"\nauthority = "a"\n' + UNIT
    text += "".join(f'[[listener]]\nurl = "{url}"\n' for url in (one, other))
    if clash:
        (problem,) = problems_of(text)
        assert problem.startswith("x.toml:9: listener[1].url: ")
        assert f" is taken by {one}" in problem
    else:
        parse_configuration(text, "x.toml")


def test_rules_for_roles_that_no_client_can_have_are_odd_but_can_be() -> None:
    text = UNIT + '[policy]\ndefault = "deny"\n[[policy.rule]]\nroles = ["operator"]\n'
    (warning,) = parse_configuration(text, "x.toml").warnings
    assert (
        str(warning)
        == "x.toml:6: policy.rule[0].roles: warning: no client can have a role: there is no tls:// listener"
    )
    assert parse_configuration(SYSTEM, "x.toml").warnings == ()


def test_rules_that_can_never_decide_are_odd_but_can_be() -> None:
    rules = '[[policy.rule]]\nname = "all"\n[[policy.rule]]\nname = "interlock"\naction = "deny"\nunits = "3"\n'
    (warning,) = parse_configuration(UNIT + '[policy]\ndefault = "deny"\n' + rules, "x.toml").warnings
    assert str(warning) == (
        "x.toml:7: policy.rule[1]: warning: 'interlock' never decides: 'all' before it takes all its requests"
    )


@pytest.mark.parametrize(
    ("configured", "named", "odd"),
    [
        ("tcp://10.0.0.5:5020", "tcp://10.0.0.5:5020", False),
        ("tcp://10.0.0.5:5020", "tcp://10.0.0.5", False),  # port 502 may be opened beside it
        ("tcp://10.0.0.5:5020", "tcp://", False),
        ("tcp://:5020", "tcp://0.0.0.0:5020", False),
        ("tcp://:5020", "tcp://[::]:5020", False),
        ("tcp://localhost:5020", "tcp://127.0.0.1:5020", False),
        ("tcp://10.0.0.5:5020", "tcp://10.0.0.5:5021", True),
        ("tcp://10.0.0.5:5020", "tcp://10.0.0.6:5020", True),
        ("tcp://10.0.0.5:5020", "udp://10.0.0.5:5020", True),
        ("tcp://10.0.0.5:5020", "tls://", True),
        ("tcp://:5020", "tcp://10.0.0.5:5020", True),
        ("rtu:///dev/a", "rtu:///dev/b", True),
        ("rtu:///dev/a", "rtu:///dev/a", False),
    ],
)
def test_rules_for_listeners_that_are_not_there_are_odd(configured: str, named: str, odd: bool) -> None:
    text = f'listen = ["{configured}"]\n{UNIT}[policy]\ndefault = "allow"\n[[policy.rule]]\n'
    text += f'action = "deny"\nlisteners = ["{named}"]\n'
    found = [str(one) for one in parse_configuration(text, "x.toml").warnings if "policy" in str(one)]
    assert [one.partition("warning: ")[2] for one in found] == (
        [f"there is no listener {named}, but {configured}"] if odd else []
    )


@pytest.mark.clause("T20")
def test_a_listener_on_every_interface_is_taken_with_a_warning() -> None:
    (warning,) = parse_configuration('listen = ["tcp://0.0.0.0:502"]\n' + UNIT, "x.toml", preflight=True).warnings
    assert str(warning).startswith("x.toml:1: listen[0]: warning: tcp://0.0.0.0:502 listens on every interface")


@pytest.mark.clause("T33")
def test_no_option_of_a_component_has_been_forgotten() -> None:
    listener = {field.name for field in fields(ListenerParameters)}
    assert listener <= set(ServerSection.model_fields)
    # Whether places are shared is said once, for all listeners.
    assert listener - {"shared_slots"} <= set(ListenerSection.model_fields)
    assert {field.name for field in fields(ServerParameters)} <= set(ServerSection.model_fields)
    assert set(options_for("server", SocketParameters)) <= set(ServerSection.model_fields)
    tls = {field.name for field in fields(TlsParameters)}
    assert set(options_for("server", TlsParameters)) <= set(ListenerSection.model_fields)
    assert tls - {"server_name"} <= set(SecuritySection.model_fields)
    for name, scheme in SCHEMES.items():
        endpoint = parse_endpoint(f"{name}:///dev/x" if scheme.carrier == "serial" else f"{name}://h:1")
        for section in (ClientSection, LinkSection):
            assert options_of(endpoint) <= set(section.model_fields), (name, section)


SCHEMAS: list[tuple[type[Section], str]] = [(SystemFile, SYSTEM), (SystemFile, DEVICES), (DeviceFile, DEVICES)]


@pytest.mark.clause("T33")
@pytest.mark.parametrize(("section", "text"), SCHEMAS)
def test_the_json_schema_permits_what_the_reader_permits(section: type[Section], text: str) -> None:
    assert faults(json_schema(section, "x"), tomllib.loads(text)) == []


@pytest.mark.parametrize(("section", "text"), SCHEMAS)
def test_the_json_schema_refuses_a_key_that_there_is_not_wherever_it_stands(section: type[Section], text: str) -> None:
    schema = json_schema(section, "x")
    tables = list(tables_of(data := tomllib.loads(text)))
    assert len(tables) > 10
    for table in tables:
        table["no_such_key"] = 1
        assert faults(schema, data)
        del table["no_such_key"]


def tables_of(data: Any) -> list[dict[str, Any]]:
    """Every table of a file whose keys are declared, the file itself included."""
    if isinstance(data, list):
        return [table for each in data for table in tables_of(each)]
    if not isinstance(data, dict):
        return []
    inner = [table for key, each in data.items() if key != "identification" for table in tables_of(each)]
    return [data, *inner]


@pytest.mark.parametrize("value", ['"1"', "true", "[[1]]", "{ a = 1 }"])
def test_the_json_schema_refuses_values_of_another_type(value: str) -> None:
    schema = json_schema(SystemFile, "x")
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert faults(schema, tomllib.loads(UNIT + f"[server]\nmax_transactions = {value}\n"))


@pytest.mark.clause("T33")
@pytest.mark.parametrize("seed", range(MUTATIONS))
def test_a_file_after_accidents_is_right_or_wrong_at_a_line_but_never_a_surprise(seed: int) -> None:
    text = after_accidents(SYSTEM, random.Random(seed))
    problems: tuple[ConfigError, ...] = ()
    try:
        configuration = parse_configuration(text, "x.toml")
    except FileError as error:
        problems = error.problems
        assert problems
    else:
        assert isinstance(configuration, Configuration)
        problems = configuration.warnings
    for problem in problems:
        assert problem.file == "x.toml"
        assert problem.line is not None
        assert 1 <= problem.line <= text.count("\n") + 1
        assert "\n" not in str(problem)


def test_the_example_of_the_reference_is_right() -> None:
    (example,) = re.findall(r"```toml\n(.*?)```", REFERENCE.read_text(encoding="utf-8"), re.DOTALL)
    configuration = parse_configuration(example, "plant.toml")
    assert (len(configuration.listeners), list(configuration.links)) == (2, ["boiler", "meters"])
    assert configuration.warnings == ()
