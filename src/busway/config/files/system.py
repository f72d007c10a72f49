"""Keys of configuration files: server, listeners, client, security, policy and units in one file.

Knows what can be written and what goes together; knows no component (`busway.config` makes them). Every device file is
a configuration file too.

An example is in `docs/reference/configuration.md`.

Rules:

1. A key of one listener or link, or an option of its URL, overrides that of the section for all of them, and that
   overrides the default. If key and URL give an option with different values, the file is refused.
2. A key that has no effect in its place is refused: users would believe that it works.
3. Paths are those of the system, or relative to the file's folder.
"""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, ClassVar, Final

from pydantic import BeforeValidator, model_validator

from ...options.accepted_options import LINKS
from ...options.declaration import Name, Range
from ...options.endpoints import parse_endpoint
from ...options.service import AuditParameters, ControlParameters, MetricsParameters
from ...options.tls import TlsParameters
from .device import DeviceFile, LinkPresetWord, UnitSection
from .key_lines import KeyPath
from .listeners import ListenerSection, Url, clashes
from .options import OptionSection, differing_from_url, with_options_of
from .policy import ActionWord, PolicySection
from .section import NO_LIST, FileProblems

DEFAULT_LISTEN: Final = "tcp://127.0.0.1:5020"
"""Where units are served if the file names no listener."""


def _unchanged(value: object) -> object:
    return value


@with_options_of(*LINKS, role="client")
class LinkKeys(OptionSection):
    """Base of file sections with options of a link.

    An option that the file leaves out is None, and one that the file sets to ``none`` is None too. `options` tells them
    apart: it returns only options that the file sets.
    """

    preset: Annotated[
        LinkPresetWord | None,
        "a set of options; `strict` ends each deviation from the documents, `passive` repeats and delays nothing.",
    ] = None

    def options(self) -> dict[str, Any]:  # of several types
        """Return the options of a link that the section sets, by name.

        The value is None if the file says ``none``. ``preset`` is among them if the section sets it.
        """
        return self.options_of(*LINKS) | ({"preset": self.preset} if "preset" in self.model_fields_set else {})


class LinkSection(LinkKeys):
    """``[[link]]``: a named endpoint with its own options, for requests to a device or server."""

    checked_later: ClassVar[tuple[type[Any], ...]] = LINKS  # together with its scheme, where the link is put together

    name: Annotated[str, Name("the name of a link"), "the name that programs, routes and devices use for it."]
    url: Annotated[Url, "the endpoint."]

    @model_validator(mode="after")
    def _check_url(self) -> "LinkSection":
        faults = list(differing_from_url(self, parse_endpoint(self.url)))
        if faults:
            raise FileProblems(faults)
        return self


class ClientSection(LinkKeys):
    """``[client]``: options for all links whose URL scheme has them."""

    supported_connections: Annotated[
        int | None, Range(1, 65_535), "connections that the process may have open at once; None: the default, 10 000."
    ] = None


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

    listen: Annotated[list[Url], "endpoints to listen on, without options of their own."] = NO_LIST
    listener: Annotated[
        Sequence[ListenerSection],
        "endpoints with options of their own; with neither, units are served on `tcp://127.0.0.1:5020`.",
    ] = NO_LIST
    security: Annotated[SecuritySection, "certificates."] = SecuritySection()
    client: Annotated[ClientSection, "options for all links."] = ClientSection()
    link: Annotated[Sequence[LinkSection], "named ways to other devices, with options of their own."] = NO_LIST
    audit: Annotated[AuditSection | None, "the audit log."] = None
    metrics: Annotated[MetricsSection | None, "metrics for Prometheus."] = None
    control: Annotated[ControlSection, "the socket that `busway status` asks."] = ControlSection()
    policy: Annotated[DeclaredPolicy | None, 'who may ask what, or in one word `"read-only"`; None: no rules.'] = None
    unit: Annotated[Sequence[UnitSection], "the devices; where something is listened on, there must be one."] = NO_LIST

    @property
    def audit_parameters(self) -> AuditParameters | None:
        """The options of the audit log; None if the file has no ``[audit]``."""
        return None if self.audit is None else self.audit.built(AuditParameters)

    @property
    def metrics_address(self) -> str | None:
        """Address and port where metrics are served, ``host:port``; None if the file has no ``[metrics]``."""
        return None if self.metrics is None else self.metrics.built(MetricsParameters).listen

    @property
    def control_parameters(self) -> ControlParameters:
        """The options of the control socket; those that the file leaves out have their defaults."""
        return self.control.built(ControlParameters)

    def places(self) -> list[tuple[KeyPath, str]]:
        """Return the URLs to listen on, each with its path in the file: first those of ``listen``, then ``listener``.

        If there are none, the only one is the default URL `DEFAULT_LISTEN` for a file with units; a file without units
        then has none.
        """
        given: list[tuple[KeyPath, str]] = [(("listen", index), url) for index, url in enumerate(self.listen)]
        given += [(("listener", index, "url"), each.url) for index, each in enumerate(self.listener)]
        return given or ([(("unit",), DEFAULT_LISTEN)] if self.unit else [])

    @model_validator(mode="after")
    def _check_whole(self) -> "SystemFile":
        faults = list(self._whole_faults())
        if faults:
            raise FileProblems(faults)
        return self

    def _whole_faults(self) -> Iterator[tuple[KeyPath, str]]:
        if not self.unit and (self.places() or not self.link):
            yield ("unit",), "is missing"
        yield from clashes(self.places())
        yield from twice("link", [each.name for each in self.link])


def twice(key: str, names: list[str]) -> Iterator[tuple[KeyPath, str]]:
    """Yield an error, as path and sentence, for each section that has the same name as an earlier one.

    Args:
        key: key of these sections in the file.
        names: the names of the sections, in order.
    """
    for index, name in enumerate(names):
        if name in names[:index]:
            yield (key, index, "name"), f"{name!r} is there already: {key}[{names.index(name)}]"
