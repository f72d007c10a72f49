"""How options are declared, and that one line is all it takes: every place that shows or takes options asks for it."""

import re
import sys
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, ClassVar

import pytest

import busway.cli.config
import busway.client.settings
import busway.options.accepted_options
from busway.cli.config import config
from busway.client.option_types import LinkOptions
from busway.client.settings import link_settings
from busway.config.files.behaviours import KINDS
from busway.config.files.collector import CollectorFile
from busway.config.files.device import DeviceFile
from busway.config.files.gateway import (
    GatewayFile,
    GatewayListenerSection,
    GatewaySection,
    RouteSection,
    UpstreamSection,
)
from busway.config.files.key_lines import KeyPath
from busway.config.files.options import OptionSection, with_options_of
from busway.config.files.section import FileProblems, Section, json_schema, keys_of, sections_of
from busway.config.files.simulation import SimulationFile
from busway.config.files.system import AuditSection, ControlSection, LinkSection, MetricsSection, SystemFile
from busway.config.files.toml_source import parse_file, read_section
from busway.errors import ConfigError
from busway.options.accepted_options import LINKS, SERVERS, AcceptedOptions, aliases, options_for
from busway.options.declaration import (
    REQUIRED,
    Alias,
    ByFraming,
    Name,
    On,
    OneOf,
    Option,
    Range,
    Strict,
    check,
    declared,
)
from busway.options.endpoints import SCHEMES, parse_endpoint
from busway.options.gateway import GatewayListenerParameters, GatewayParameters, RouteParameters, UpstreamParameters
from busway.options.service import AuditParameters, ControlParameters, MetricsParameters
from busway.options.text import build_parameters
from busway.server.option_types import ServerOptions

ROOT = Path(__file__).resolve().parents[2]
TABLE = (ROOT / "docs" / "reference" / "defaults.md").read_text(encoding="utf-8")
URLS = {name: f"{name}:///dev/x" if one.carrier == "serial" else f"{name}://h:1" for name, one in SCHEMES.items()}


class Mood(Enum):
    """Words of an option."""

    CALM = "calm"
    HASTY = "hasty"


@dataclass(frozen=True, slots=True)
class AddedParameters:
    """A class with options of every kind."""

    on: ClassVar = On("client tcp", "client rtu")

    haste: Annotated[
        float,
        Range(0.5, 20, "seconds"),
        ByFraming({"mbap": 2.0, "rtu": 4.0}),
        Strict("T99", 1.0, adaptable=True),
        Alias("hurry"),
        "seconds between two",
        "of these.",
    ] = 4.0
    width: Annotated[int | None, OneOf((2, 4)), On("rtu"), "how wide."] = None
    depth: Annotated[float, Range(0, 9, above=True), "how deep."] = 1.0
    label: Annotated[str | None, Name("the name of a thing"), "what it is called."] = None
    mood: Annotated[Mood, "how it is."] = Mood.CALM
    rest: Annotated[float | Mood, Range(1, 5), "how long."] = Mood.CALM
    loud: Annotated[bool, "whether it is heard."] = False

    def __post_init__(self) -> None:
        check(self)


def test_a_declaration_says_everything_of_an_option() -> None:
    options = declared(AddedParameters)
    assert list(options) == [field.name for field in fields(AddedParameters)]
    haste = options["haste"]
    assert (haste.kinds, haste.is_optional, haste.default) == ((float,), False, 4.0)
    assert haste.help == "seconds between two of these."
    assert haste.aliases == ("hurry",)
    assert haste.strict == Strict("T99", 1.0, adaptable=True)
    assert haste.default_text == "2 (TCP, TLS, UDP); 4 (RTU)"
    assert options["width"].is_optional
    assert [one.values for one in options.values()] == [
        "0.5…20 seconds",
        "2 or 4, or none",
        "0…9",
        "a text, or none",
        "`calm`, `hasty`",
        "1…5, `calm`, `hasty`",
        "`true`, `false`",
    ]
    assert declared(AddedParameters) is options


@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("haste", 0.4, "must be 0.5…20 seconds, not 0.4"),
        ("haste", float("nan"), "must be 0.5…20 seconds, not nan"),
        ("width", 3, "must be 2 or 4, not 3"),
        ("depth", 0.0, "must be 0…9, not 0"),
        ("label", "", "must be the name of a thing, not ''"),
        ("mood", "sad", "must be calm or hasty, not 'sad'"),
        ("rest", 6.0, "must be 1…5, calm or hasty, not 6"),
    ],
)
def test_what_an_option_cannot_be_is_refused_with_what_it_can_be(option: str, value: object, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        AddedParameters(**{option: value})  # type: ignore[arg-type]
    assert (caught.value.key, caught.value.message) == (option, sentence)


def test_texts_become_values_and_defaults_follow_the_framing() -> None:
    given = {"haste": "7", "width": "none", "mood": "hasty", "rest": "calm", "loud": "yes"}
    made = build_parameters(AddedParameters, given)
    assert made == AddedParameters(haste=7.0, mood=Mood.HASTY, rest=Mood.CALM, loud=True)
    assert [build_parameters(AddedParameters, {}, framing=one).haste for one in ("mbap", "rtu", "ascii")] == [2, 4, 4]


@pytest.mark.parametrize(
    ("url", "role", "names"),
    [
        ("tcp://h", "client", {"haste", "depth", "label", "mood", "rest", "loud"}),
        ("rtu:///dev/x", "client", {"haste", "width", "depth", "label", "mood", "rest", "loud"}),
        ("udp://h", "client", set()),
        ("tcp://h", "server", set()),
    ],
)
def test_an_option_is_on_offer_where_it_has_an_effect(url: str, role: str, names: set[str]) -> None:
    assert set(AcceptedOptions.at(parse_endpoint(url), role, (AddedParameters,)).options) == names


def test_a_role_has_the_options_that_have_an_effect_for_it_somewhere() -> None:
    assert set(options_for("client", AddedParameters)) == {field.name for field in fields(AddedParameters)}
    assert options_for("server", AddedParameters) == {}


# One added line.


def script(name: str) -> Any:
    """A module of the folder ``scripts``."""
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        return __import__(name)
    finally:
        sys.path.pop(0)


def test_an_option_that_is_added_appears_everywhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kinds = (*LINKS, AddedParameters)
    for module in (busway.client.settings, busway.options.accepted_options):
        monkeypatch.setattr(module, "LINKS", kinds)
    aliases.cache_clear()
    try:
        # URL and keyword, with its alias, its range and the preset
        link_settings("tcp://h?hurry=3", {"mood": "hasty"})
        with pytest.raises(ConfigError, match="haste: unknown option of udp"):
            link_settings("udp://h?haste=3", {})
        accepted = AcceptedOptions.at(parse_endpoint("tcp://h"), "client", kinds)
        assert accepted.chosen({"preset": "strict"}).build(AddedParameters).haste == 1.0
        assert accepted.chosen({}).build(AddedParameters).haste == 2.0
    finally:
        aliases.cache_clear()
    # TOML, and its JSON Schema
    section = with_options_of(*kinds, role="client")(OptionSection)
    read = parse_file('haste = 3.0\nrest = "hasty"\nwidth = "none"\n', section, "x.toml")
    assert read.options() == {"haste": 3.0, "rest": "hasty", "width": None}
    with pytest.raises(ConfigError, match=r"haste: must be 0\.5…20 seconds, not 30"):
        parse_file("haste = 30.0\n", section, "x.toml")
    key = json_schema(section, "x")["properties"]["haste"]
    assert key == {"type": "number", "description": "seconds between two of these.", "minimum": 0.5, "maximum": 20}
    # help
    config("options", "tcp://h", device=False, simulation=False, gateway=False, collector=False)
    assert re.search(r"^  haste +2 \(TCP, TLS, UDP\).* 0.5…20 seconds +seconds between", capsys.readouterr().out, re.M)
    # the types of keywords, and the table of the reference
    keys = script("option_types").Source("client").keys(kinds, role="client")
    assert (keys["haste"], keys["hurry"], keys["width"]) == ("float", "float", "int | None")
    row = "| `haste` | 2 (TCP, TLS, UDP); 4 (RTU) | 0.5…20 seconds | seconds between two of these. |"
    assert row in script("option_tables").render(AddedParameters)


SCHEMA = json_schema(SystemFile, "x")
LINK_OPTIONS = AcceptedOptions.of(*LINKS, role="client").options
SERVER_OPTIONS = AcceptedOptions.of(*SERVERS, role="server").options


@pytest.mark.parametrize("option", LINK_OPTIONS.values(), ids=LINK_OPTIONS)
def test_an_option_of_links_is_in_urls_keywords_files_schema_and_table(option: Option) -> None:
    offers = [AcceptedOptions.at(parse_endpoint(url), "client", LINKS) for url in URLS.values()]
    assert any(option.name in accepted.names for accepted in offers)
    assert {option.name, *option.aliases} <= set(LinkOptions.__annotations__)
    assert option.name in LinkSection.model_fields
    schema = SCHEMA["$defs"]["LinkSection"]["properties"][option.name]
    assert schema["description"] == option.help
    assert f"| `{option.name}` | {option.default_text} | {option.values} | {option.help} |" in TABLE


@pytest.mark.parametrize("option", SERVER_OPTIONS.values(), ids=SERVER_OPTIONS)
def test_an_option_of_servers_is_in_keywords_files_schema_and_table(option: Option) -> None:
    assert option.name in ServerOptions.__annotations__
    schema = SCHEMA["$defs"]["ServerSection"]["properties"][option.name]
    assert schema["description"] == option.help
    assert f"| `{option.name}` | {option.default_text} | {option.values} | {option.help} |" in TABLE


@pytest.mark.parametrize(
    ("section", "kind"),
    [
        (GatewaySection, GatewayParameters),
        (UpstreamSection, UpstreamParameters),
        (GatewayListenerSection, GatewayListenerParameters),
    ],
)
def test_the_options_of_gateways_are_in_files_schema_and_table(section: type[Section], kind: type[Any]) -> None:
    properties = json_schema(section, "x")["properties"]
    for option in declared(kind).values():
        assert properties[option.name]["description"] == option.help
        assert f"| `{option.name}` | {option.default_text} | {option.values} | {option.help} |" in TABLE


FILES = (SystemFile, DeviceFile, SimulationFile, GatewayFile, CollectorFile)
SECTIONS = list(dict.fromkeys(section for file in FILES for section in sections_of(file)))
"""Every table that a file may have."""


def printed_options(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The lines of ``busway config options``."""
    config("options", None, device=False, simulation=False, gateway=False, collector=False)
    return capsys.readouterr().out.splitlines()


def test_help_lists_every_option_and_every_key_of_files_once(capsys: pytest.CaptureFixture[str]) -> None:
    listed = [found[1] for line in printed_options(capsys) if (found := re.match(r"  (\w+) ", line))]
    of_links_and_servers = [*LINK_OPTIONS, *SERVER_OPTIONS]
    assert listed[: len(of_links_and_servers)] == of_links_and_servers
    keys: list[Option] = []
    for section in SECTIONS:
        keys += [option for option in keys_of(section).values() if option not in keys]
    known = [*LINK_OPTIONS.values(), *SERVER_OPTIONS.values()]
    assert sorted(listed[len(known) :]) == sorted(option.name for option in keys if option not in known)


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.__name__)
def test_every_key_of_a_file_says_what_it_means_and_so_does_the_schema(section: type[Section]) -> None:
    properties = json_schema(section, "x").get("properties", {})
    for name, option in keys_of(section).items():
        assert option.help.endswith((".", "`.")), f"{section.__name__}.{name}"
        shown = properties.get(name, {"description": option.help})  # a section that holds itself is a reference
        assert shown["description"] == option.help


def test_every_table_of_a_file_is_on_a_page() -> None:
    shown = {kind for parts in script("option_tables").PAGES.values() for kinds in parts.values() for kind in kinds}
    shown |= {parent for kind in shown for parent in kind.__mro__} | set(KINDS.values())
    unnamed = {"Hexadecimal", "HolesSection", "SimulatedUnitSection", "SimulatedPointSection", "SimulatedGroupSection"}
    left_out = [
        section.__name__
        for section in SECTIONS
        if section not in shown
        and section.__name__ not in unnamed
        and not (issubclass(section, OptionSection) and section.kinds)  # those are tables of parameter classes
        and section not in FILES
    ]
    assert left_out == []


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.__name__)
def test_a_key_that_is_added_to_a_table_appears_everywhere(
    section: type[Section], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hint = Annotated[float, Range(0.5, 20, "seconds"), "seconds between two", "of these."]
    names = {"__annotations__": {"haste": hint}, "haste": 4.0, "__module__": section.__module__, "__doc__": "Added."}
    added = type(section)("Added", (section,), names)
    # TOML, with the errors of a wrong value and of a wrong key
    faults = dict(faults_of_reading(added, {"haste": 30.0}))
    assert faults["haste",] == "must be 0.5…20 seconds, not 30"
    assert faults_of_reading(added, {"hast": 1.0})["hast",] == "unknown key; is it haste?"
    # JSON Schema
    key = {"type": "number", "description": "seconds between two of these.", "minimum": 0.5, "maximum": 20}
    document = json_schema(added, "x")
    properties = document["properties"] if "properties" in document else document["$defs"]["Added"]["properties"]
    assert properties["haste"] == {**key, "default": 4.0}
    # help
    monkeypatch.setattr(busway.cli.config, "_schemas", lambda: {"": added})
    assert any(re.match(r"  haste +4 +0\.5…20 seconds +seconds between", line) for line in printed_options(capsys))
    # the table of the reference
    row = "| `haste` | 4 | 0.5…20 seconds | seconds between two of these. |"
    assert row in script("option_tables").render(added)


def faults_of_reading(section: type[Section], data: dict[str, object]) -> dict[KeyPath, str]:
    """What is wrong with a table, by path."""
    with pytest.raises(FileProblems) as caught:
        read_section(section, data)
    return dict(caught.value.faults)


@pytest.mark.parametrize(
    ("section", "kind"),
    [
        (AuditSection, AuditParameters),
        (MetricsSection, MetricsParameters),
        (ControlSection, ControlParameters),
        (RouteSection, RouteParameters),
    ],
)
def test_a_section_of_a_file_has_the_keys_of_its_declaration_and_the_schema_says_their_ranges(
    section: type[Section], kind: type[Any]
) -> None:
    assert set(section.model_fields) == set(declared(kind))
    schema = json_schema(section, "x")
    required = [name for name, option in declared(kind).items() if option.default is REQUIRED]
    assert schema.get("required", []) == required
    for name, option in declared(kind).items():
        assert schema["properties"][name]["description"] == option.help
        if isinstance(option.limits, Range):
            assert schema["properties"][name]["maximum"] == option.limits.high
