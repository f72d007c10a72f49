"""Keys of configuration files: server, listeners, client, security, policy and units in one file.

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

from pydantic import BeforeValidator, Field, model_validator

from ...options.offer import LINKS
from ...options.service import AuditParameters, ControlParameters, MetricsParameters
from ...options.tls import TlsParameters
from .device import DeviceFile, UnitSection
from .lines import Path
from .listeners import ListenerSection, Url, clashes
from .options import OptionSection, with_options_of
from .policy import ActionWord, PolicySection
from .schema import FileProblems

DEFAULT_LISTEN: Final = "tcp://127.0.0.1:5020"
"""Where units are served if the file does not say."""


def _unchanged(value: object) -> object:
    return value


@with_options_of(*LINKS, role="client")
class LinkKeys(OptionSection):
    """Base of the sections with options of a link; one that the file leaves out stays unset."""

    preset: Literal["standard", "strict"] | None = None

    def options(self) -> dict[str, Any]:  # of several types
        """Return the options of a link that the section sets, by name."""
        return self.options_of(*LINKS) | ({"preset": self.preset} if "preset" in self.model_fields_set else {})


class LinkSection(LinkKeys):
    """``[[link]]``: a named endpoint with its own options, for requests to a device or server."""

    checked_later: ClassVar[tuple[type[Any], ...]] = LINKS  # together with its scheme, where the link is put together

    name: str = Field(min_length=1)
    url: Url


class ClientSection(LinkKeys):
    """``[client]``: options for all links whose URL scheme has them."""

    retired: ClassVar[dict[str, str]] = {"link": "[[link]]"}

    supported_connections: int | None = Field(default=None, ge=1, le=65_535)


@with_options_of(TlsParameters, without=frozenset({"server_name"}))
class SecuritySection(OptionSection):
    """``[security]``: certificates of this host, for each ``tls://`` listener and link without its own."""


@with_options_of(AuditParameters)
class AuditSection(OptionSection):
    """``[audit]``: the log file of writes and denied requests."""


@with_options_of(MetricsParameters)
class MetricsSection(OptionSection):
    """``[metrics]``: the address where Prometheus can scrape metrics."""


@with_options_of(ControlParameters)
class ControlSection(OptionSection):
    """``[control]``: the socket that ``busway status`` connects to."""


DeclaredPolicy = Annotated[
    PolicySection, BeforeValidator(_unchanged, json_schema_input_type=ActionWord | PolicySection)
]


class SystemFile(DeviceFile):
    """The checked contents of a configuration file."""

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

    @property
    def audit_parameters(self) -> AuditParameters | None:
        """Return the options of the audit log; None without one."""
        return None if self.audit is None else self.audit.built(AuditParameters)

    @property
    def metrics_address(self) -> str | None:
        """Return address and port where metrics are served; None without them."""
        return None if self.metrics is None else self.metrics.built(MetricsParameters).listen

    @property
    def control_parameters(self) -> ControlParameters:
        """Return the options of the control socket."""
        return self.control.built(ControlParameters)

    def places(self) -> list[tuple[Path, str]]:
        """Return the URLs to listen on, each with its path in the file."""
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
    """Return errors for equal names in sections of one kind: the path of the later one, and a sentence."""
    for index, name in enumerate(names):
        if name in names[:index]:
            yield (key, index, "name"), f"{name!r} is there already: {key}[{names.index(name)}]"
