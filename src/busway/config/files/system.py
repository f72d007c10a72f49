"""The schema of configuration files: server, listeners, client, security, policy and units in one file.

Knows what can be written and what goes together; knows no component (`busway.config` makes them). Every device file
is a configuration file too.

::

    [security]
    certificate = "server.pem"
    key = "server.key"
    authority = "ca.pem"

    [[listener]]
    url = "tcp://:502"
    allow = ["10.0.0.0/8"]

    [[listener]]
    url = "tls://:802"

    [policy]
    default = "read-only"

    [[link]]
    name = "boiler"
    url = "tcp://10.0.0.5"

    [[unit]]
    unit = 1
    holding_registers = 1000

Rules:

1. What belongs to one listener or link goes before what its section says for all, and that before the defaults.
2. A key that has no effect where it stands is refused: it would be believed to work.
3. Paths are those of the system, or relative to the file's folder.
"""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from ...errors import ConfigError
from ...options.offer import LINKS
from ...options.tls import TlsParameters
from .device import DeviceFile, UnitSection
from .lines import Path
from .listeners import ListenerSection, Url, clashes
from .options import OptionSection, with_options_of
from .policy import ActionWord, PolicySection
from .schema import FileProblems, Section, Source, read_source

DEFAULT_LISTEN: Final = "tcp://127.0.0.1:5020"
"""Where units are served if the file does not say."""


def read_system_file(text: str, name: str) -> "tuple[SystemFile, Source]":
    """A configuration file, its shape checked, and where everything in it stands.

    Args:
        text: its content.
        name: its name, for the sentences.

    Raises:
        FileError: all that is wrong with it, each with file, line and key.
    """
    source = read_source(text, name)
    return source.checked(SystemFile), source


def host_and_port(text: str) -> tuple[str, int]:
    """``127.0.0.1:9502`` or ``[::1]:9502`` in two. Raises `ConfigError`."""
    host, colon, port = text.rpartition(":")
    bare = host[1:-1] if host[:1] == "[" and host[-1:] == "]" else host
    if not colon or not bare or (":" in bare and bare == host) or not (port.isascii() and port.isdecimal()):
        raise ConfigError(f"must be HOST:PORT, for example 127.0.0.1:9502, not {text!r}")
    if int(port) > 65_535:
        raise ConfigError(f"a port is 0…65535, not {port}")
    return bare, int(port)


def _unchanged(value: object) -> object:
    return value


def _checked_place(text: str) -> str:
    host_and_port(text)
    return text


FilePath = Annotated[str, Field(min_length=1)]


@with_options_of(*LINKS, role="client")
class LinkKeys(OptionSection):
    """The options of a link. None of them is set by being left out."""

    preset: Literal["standard", "strict"] | None = None

    def options(self) -> dict[str, Any]:  # of several types
        """The options of a link that are set here, by name."""
        return self.options_of(*LINKS) | ({"preset": self.preset} if "preset" in self.model_fields_set else {})


class LinkSection(LinkKeys):
    """``[[link]]``: one endpoint that requests go to, under a name, with options of its own."""

    checked_later: ClassVar[tuple[type[Any], ...]] = LINKS  # together with its scheme, where the link is put together

    name: str = Field(min_length=1)
    url: Url


class ClientSection(LinkKeys):
    """``[client]``: options for all links whose scheme has the option."""

    retired: ClassVar[dict[str, str]] = {"link": "[[link]]"}

    supported_connections: int | None = Field(default=None, ge=1, le=65_535)


@with_options_of(TlsParameters, without=frozenset({"server_name"}))
class SecuritySection(OptionSection):
    """``[security]``: certificates of this host, for each ``tls://`` listener and link that says nothing else."""


class AuditSection(Section):
    """``[audit]``: the log of denied requests and of writes."""

    path: FilePath
    interval: float = Field(default=0.2, ge=0, le=10)
    on_failure: Literal["serve", "refuse"] = "serve"
    repeat_interval: float = Field(default=60.0, ge=0, le=3600)


class MetricsSection(Section):
    """``[metrics]``: where figures are offered to Prometheus."""

    listen: Annotated[str, AfterValidator(_checked_place)]


class ControlSection(Section):
    """``[control]``: the socket that ``busway status`` asks."""

    enabled: bool = True
    path: FilePath | None = None


DeclaredPolicy = Annotated[
    PolicySection, BeforeValidator(_unchanged, json_schema_input_type=ActionWord | PolicySection)
]


class SystemFile(DeviceFile):
    """A whole configuration file."""

    listen: list[Url] = Field(default_factory=list)
    listener: Sequence[ListenerSection] = Field(default_factory=list)
    security: SecuritySection = SecuritySection()
    client: ClientSection = ClientSection()
    link: Sequence[LinkSection] = Field(default_factory=list)
    audit: AuditSection | None = None
    metrics: MetricsSection | None = None
    control: ControlSection = ControlSection()
    policy: DeclaredPolicy | None = None
    unit: Sequence[UnitSection] = Field(default_factory=list)

    def places(self) -> list[tuple[Path, str]]:
        """The URLs that are listened on, each with where it stands."""
        given: list[tuple[Path, str]] = [(("listen", index), url) for index, url in enumerate(self.listen)]
        given += [(("listener", index, "url"), each.url) for index, each in enumerate(self.listener)]
        return given or ([(("unit",), DEFAULT_LISTEN)] if self.unit else [])

    @model_validator(mode="after")
    def _check_whole(self) -> "SystemFile":
        faults = list(self._whole_faults())
        if faults:
            raise FileProblems(faults)
        return self

    def _whole_faults(self) -> Iterator[tuple[Path, str]]:
        if not self.unit and (self.places() or not self.link):
            yield ("unit",), "is missing"
        yield from clashes(self.places())
        yield from twice("link", [each.name for each in self.link])


def twice(key: str, names: list[str]) -> Iterator[tuple[Path, str]]:
    """Names that sections of one kind share: the place of the later one, and a sentence."""
    for index, name in enumerate(names):
        if name in names[:index]:
            yield (key, index, "name"), f"{name!r} is there already: {key}[{names.index(name)}]"
