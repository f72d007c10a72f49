"""How options are declared, and that one line is all it takes: every place that shows or takes options asks for it."""

import re
import sys
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, ClassVar

import pytest

import busway.client.settings
import busway.options.offer
from busway.cli.config import config
from busway.client.option_types import LinkOptions
from busway.client.settings import link_settings
from busway.config.files.gateway import GatewayListenerSection, GatewaySection, RouteSection, UpstreamSection
from busway.config.files.options import OptionSection, with_options_of
from busway.config.files.schema import Section, json_schema, parse_file
from busway.config.files.system import AuditSection, ControlSection, LinkSection, MetricsSection, SystemFile
from busway.errors import ConfigError
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
from busway.options.offer import LINKS, SERVERS, Offer, aliases, options_for
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
    assert set(Offer.at(parse_endpoint(url), role, (AddedParameters,)).options) == names


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
    for module in (busway.client.settings, busway.options.offer):
        monkeypatch.setattr(module, "LINKS", kinds)
    aliases.cache_clear()
    try:
        # URL and keyword, with its alias, its range and the preset
        link_settings("tcp://h?hurry=3", {"mood": "hasty"})
        with pytest.raises(ConfigError, match="haste: unknown option of udp"):
            link_settings("udp://h?haste=3", {})
        offer = Offer.at(parse_endpoint("tcp://h"), "client", kinds)
        assert offer.chosen({"preset": "strict"}).build(AddedParameters).haste == 1.0
        assert offer.chosen({}).build(AddedParameters).haste == 2.0
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
    config("options", "tcp://h", device=False, simulation=False, gateway=False)
    assert re.search(r"^  haste +2 \(TCP, TLS, UDP\).* 0.5…20 seconds +seconds between", capsys.readouterr().out, re.M)
    # the types of keywords, and the table of the reference
    keys = script("option_types").Source("client").keys(kinds, role="client")
    assert (keys["haste"], keys["hurry"], keys["width"]) == ("float", "float", "int | None")
    row = "| `haste` | 2 (TCP, TLS, UDP); 4 (RTU) | 0.5…20 seconds | seconds between two of these. |"
    assert row in script("defaults_table").render(AddedParameters)


SCHEMA = json_schema(SystemFile, "x")
LINK_OPTIONS = Offer.of(*LINKS, role="client").options
SERVER_OPTIONS = Offer.of(*SERVERS, role="server").options


@pytest.mark.parametrize("option", LINK_OPTIONS.values(), ids=LINK_OPTIONS)
def test_an_option_of_links_is_in_urls_keywords_files_schema_and_table(option: Option) -> None:
    offers = [Offer.at(parse_endpoint(url), "client", LINKS) for url in URLS.values()]
    assert any(option.name in offer.names for offer in offers)
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


def test_help_lists_every_option_of_links_servers_and_sections_of_files(capsys: pytest.CaptureFixture[str]) -> None:
    config("options", None, device=False, simulation=False, gateway=False)
    listed = re.findall(r"^  (\w+) ", capsys.readouterr().out, re.MULTILINE)
    sections = (AuditParameters, MetricsParameters, ControlParameters, GatewayParameters)
    of_gateways = (GatewayListenerParameters, UpstreamParameters, RouteParameters)
    of_files = [name for kind in (*sections, *of_gateways) for name in declared(kind)]
    assert listed == [*LINK_OPTIONS, *SERVER_OPTIONS, *of_files]


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
