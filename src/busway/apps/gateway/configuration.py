"""Reads the configuration of a gateway from one file, or from a few URLs, and builds the gateway.

Knows which section of the file becomes which part of a gateway; `route_checks` checks the routes. Reads no other file,
except certificates and the like with ``preflight``.

>>> configuration = load_gateway("gateway.toml")                       # doctest: +SKIP
>>> async with configuration.serve() as gateway: ...                   # doctest: +SKIP
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ...access.rules import AccessRules, Policy
from ...client.settings import link_settings
from ...config.file_text import read_text
from ...config.files.file_error import FileError
from ...config.files.gateway import GatewayFile, GatewayListenerSection, UpstreamSection
from ...config.files.key_lines import KeyPath
from ...config.files.toml_source import Source, parse_with_source
from ...config.links import NamedLink
from ...config.report import ConfigurationReport
from ...errors import ConfigError
from ...options.client import CLIENT_DEADLINE
from ...options.endpoints import Endpoint, parse_endpoint
from ...options.gateway import GatewayListenerParameters, UpstreamParameters
from ...options.server import ListenerParameters, ServerParameters, UnitParameters
from ...options.sockets import SocketParameters
from ...options.tls import TlsParameters
from ...server.listener import Listener
from ...server.listener_settings import listener_settings
from ...server.server_options import with_server_preset
from ..service.configuration import Configuration, put_together
from ..service.reloadable_sections import GATEWAY_SECTIONS
from .file_routes import PlacedListener, PlacedRoute, placed_routes, unit_gaps
from .gateway import Gateway
from .gateway_plan import UPSTREAM_DEFAULTS, GatewayListener, GatewayPlan, UpstreamSettings
from .route_checks import check_routes
from .routes import RoutingTable

COMMAND = "busway gateway"
"""Stands for the name of the file in messages about a configuration that comes from the command line alone."""
_SERVER_KINDS: Mapping[str, type[Any]] = {
    "parameters": ServerParameters,
    "listener": ListenerParameters,
    "sockets": SocketParameters,
}


@dataclass(frozen=True, slots=True)
class GatewayConfiguration:
    """The checked contents of a gateway file.

    Attributes:
        common: the parts that a server's configuration has, too: security, policy, audit log, metrics, control.
        file: all sections of the file.
        plan: listeners, upstreams and routes.
        routes: the routes, each with its path in the file.
        at_once: sections whose changes take effect when a running gateway reads the file again.
    """

    common: Configuration
    file: GatewayFile
    plan: GatewayPlan
    routes: tuple[PlacedRoute, ...]
    at_once: frozenset[str] = GATEWAY_SECTIONS

    @property
    def name(self) -> str:
        """Path of the gateway file, as it was given; `COMMAND` if there is no file (`simple_gateway`)."""
        return self.common.name

    @property
    def listeners(self) -> tuple[Listener, ...]:
        """The listeners that the gateway file declares, in their order."""
        return tuple(listener.settings for listener in self.plan.listeners)

    @property
    def access(self) -> AccessRules | None:
        """The access rules of the gateway file; None without any."""
        return self.common.access

    @property
    def audit(self) -> str | None:
        """Path of the gateway's audit log; None if the file declares none."""
        return self.common.audit

    @property
    def control(self) -> str | None:
        """Path or address of the gateway's control socket; None for the default one, or if the file switches it off.

        ``file.control_parameters.enabled`` tells which.
        """
        return self.common.control

    @property
    def warnings(self) -> tuple[ConfigError, ...]:
        """Warnings about the file, each with file, line and key."""
        return self.common.warnings

    def serve(self, listen: Iterable[str | Listener] = (), **options: Any) -> Gateway:  # Any: as `Gateway` takes them
        """Create the gateway that the file declares, with the file's policy and address lists; it is not started yet.

        Audit log, metrics and control socket of the file are not opened: `busway gateway` does that, and a program
        opens those that it wants.

        Args:
            listen: URLs or listeners that replace the file's, as many and in the same order; empty to use the file's.
            options: ``authorize`` and ``policy`` instead of the file's; ``audit`` and ``observers`` as of `Gateway`;
                ``standard_port`` as of `busway.serve`.

        Raises:
            ConfigError: an option is invalid, or ``listen`` has another number of listeners than the file.
        """
        plan = self._plan(listen)
        beside = options.pop("standard_port", None)
        if beside is not None:
            plan = replace(plan, server={**plan.server, "standard_port": beside})
        return Gateway(plan, **{**self.common.guarded(), **options})

    async def apply_to(
        self,
        running: object,
        listen: Sequence[Listener],
        *,
        policy: Policy | None,
        when_applied: Callable[[Sequence[str]], None],
    ) -> list[str]:
        """Apply this configuration to a gateway that runs, and return what changed, in words: one text for each part.

        Own unit, functions and options of servers stay as they are: only a restart changes them.

        Args:
            running: the `Gateway`, made from an earlier version of the file.
            listen: the listeners to use, one for each listener of the file, in the same order.
            policy: the policy of new listeners until `Gateway.replace_policy`; None for the policy of the existing
                listeners.
            when_applied: called with the result, in the step in which the routes change.

        Raises:
            LinkDown, ConfigError: a new listener or upstream cannot be opened; the old configuration is in force again,
                but listeners and serial ports that were to change have lost their connections.
        """
        assert isinstance(running, Gateway)
        old = running.plan
        plan = replace(
            self._plan(listen),
            own_unit=old.own_unit,
            own_registers=old.own_registers,
            functions=old.functions,
            server=old.server,
        )
        return await running.change(plan, policy=policy, when_applied=when_applied)

    def _plan(self, listen: Iterable[str | Listener]) -> GatewayPlan:
        wanted = [one if isinstance(one, Listener) else Listener(one) for one in listen] or self.listeners
        if len(wanted) != len(self.plan.listeners):
            raise ConfigError(
                f"there are {len(self.plan.listeners)} listeners to replace, not {len(wanted)}", key="listen"
            )
        pairs = zip(self.plan.listeners, wanted, strict=True)
        return replace(self.plan, listeners=tuple(replace(listener, settings=one) for listener, one in pairs))


def load_gateway(
    path: str | os.PathLike[str], *, preflight: bool = False, changes: Mapping[str, Any] | None = None
) -> GatewayConfiguration:
    """Load the configuration of a gateway from a file.

    Args:
        path: path of the file, in TOML.
        preflight: whether to open files that it names, too, such as certificates, so that their errors are found now.
        changes: options of all listeners, by name, that override the file's.

    Raises:
        ConfigError: the file cannot be read.
        FileError: the file is invalid; ``problems`` has all errors, each with file, line and key.
    """
    name = os.fspath(path)
    return parse_gateway(read_text(name), name, preflight=preflight, changes=changes)


def parse_gateway(
    text: str, name: str, *, preflight: bool = False, changes: Mapping[str, Any] | None = None
) -> GatewayConfiguration:
    """Parse the configuration of a gateway from a TOML text.

    Args:
        text: content of the file.
        name: name of the file, for messages; paths in the text are relative to its folder.
        preflight, changes: as of `load_gateway`.

    Raises:
        FileError: the text is invalid; ``problems`` has all errors, each with file, line and key.
    """
    file, source = parse_with_source(text, GatewayFile, name)
    return _put_together(file, source, preflight=preflight, changes=changes)


def simple_gateway(
    listeners: Sequence[str],
    upstream: str,
    *,
    changes: Mapping[str, Any] | None = None,
    client_deadline: float | None = CLIENT_DEADLINE,
) -> GatewayConfiguration:
    """Return the configuration of a gateway without a file: all units of all listeners go to one upstream.

    Args:
        listeners: URLs to listen on.
        upstream: URL of the line or server that requests are forwarded to.
        changes: as of `load_gateway`.
        client_deadline: seconds within which each request is answered, 0.001…3600; None for no limit.

    Raises:
        ConfigError: a URL, an option in it or in ``changes`` is invalid, or the upstream leads back to a listener.
    """
    for url in listeners:
        listener_settings(Listener(url), limits=ListenerParameters())
    link_settings(upstream, {})
    source = Source(COMMAND, {"listen": list(listeners), "link": [{"name": "line", "url": upstream}]}, {})
    # There is no file whose lines errors and warnings could name.
    try:
        made = _put_together(source.checked(GatewayFile), source, changes=changes, client_deadline=client_deadline)
    except FileError as error:
        raise ConfigError("; ".join(each.message for each in error.problems)) from error
    warnings = tuple(ConfigError(each.message, file=COMMAND) for each in made.warnings)
    return replace(made, common=replace(made.common, warnings=warnings))


def _put_together(
    file: GatewayFile,
    source: Source,
    *,
    preflight: bool = False,
    changes: Mapping[str, Any] | None = None,
    client_deadline: float | None = CLIENT_DEADLINE,
) -> GatewayConfiguration:
    """Build the configuration of a gateway from the sections of its file. Raises `FileError` with all errors in it.

    Args:
        file: the sections.
        source: the text of the file, for the lines of errors.
        preflight, changes: as for `load_gateway`.
        client_deadline: seconds within which requests are answered at listeners without a section; None for no limit.
    """
    name = source.name
    report = ConfigurationReport(source)
    common = put_together(file, name, report, preflight=preflight, changes=changes, link_defaults=UPSTREAM_DEFAULTS)
    listeners = _named_apart(
        [_placed_listener(file, place, parse_endpoint(url), client_deadline) for place, url in file.places()]
    )
    upstreams = {}
    for index, section in enumerate(file.link):
        link = common.links.get(section.name)
        upstream = None if link is None else _upstream(section, link, ("link", index), report)
        if upstream is not None:
            upstreams[upstream.name] = upstream
    routes = placed_routes(file, upstreams, report)
    check_routes(file, routes, listeners, upstreams, None if common.access is None else common.access.policy, report)
    served, server = _as_served(common)
    warnings = report.end()
    plan = GatewayPlan(
        listeners=tuple(
            GatewayListener(listener.name, settings, listener.deadline, _is_silent(file, listener.place))
            for listener, settings in zip(listeners, served, strict=True)
        ),
        upstreams=tuple(replace(upstream, unit_gaps=unit_gaps(routes, name)) for name, upstream in upstreams.items()),
        table=RoutingTable(tuple(one.route for one in routes)),
        own_unit=file.gateway.parameters().own_unit,
        own_registers=file.gateway.parameters().own_registers,
        server=server,
    )
    return GatewayConfiguration(replace(common, warnings=warnings), file, plan, tuple(routes))


def _section_of(file: GatewayFile, place: KeyPath) -> GatewayListenerSection | None:
    return file.listener[int(place[1])] if place[0] == "listener" else None


def _placed_listener(file: GatewayFile, place: KeyPath, endpoint: Endpoint, deadline: float | None) -> PlacedListener:
    section = _section_of(file, place)
    if section is None:
        return PlacedListener(file.listen[int(place[1])], endpoint, place, deadline, deadline != CLIENT_DEADLINE)
    is_chosen = "client_deadline" in section.model_fields_set
    chosen = section.built(GatewayListenerParameters).client_deadline
    return PlacedListener(section.title, endpoint, place, chosen, is_chosen)


def _named_apart(listeners: Sequence[PlacedListener]) -> list[PlacedListener]:
    """Return the listeners with unique names: of two with the same name, the second gets the suffix ``(2)``.

    The name of a listener is its URL by default, and several may have the same URL if its port is 0.
    """
    named: dict[str, PlacedListener] = {}
    for listener in listeners:
        name, number = listener.name, 1
        while name in named:
            number += 1
            name = f"{listener.name} ({number})"
        named[name] = replace(listener, name=name)
    return list(named.values())


def _is_silent(file: GatewayFile, place: KeyPath) -> bool:
    section = _section_of(file, place)
    return section is not None and section.built(GatewayListenerParameters).silent_broadcasts


def _upstream(
    section: UpstreamSection, link: NamedLink, at: KeyPath, report: ConfigurationReport
) -> UpstreamSettings | None:
    return report.make(
        lambda: UpstreamSettings(
            section.name,
            link.settings,
            section.built(UpstreamParameters),
            same_device=tuple(frozenset(group) for group in section.same_device),
        ),
        lambda key: at if key is None else (*at, key),
    )


def _as_served(common: Configuration) -> tuple[list[Listener], dict[str, Any]]:  # Any: as `Server` takes them
    """Return the listeners, and the keyword arguments for `Server` that all listeners share.

    The options of the file's preset are applied to the listeners and to the keyword arguments.
    """
    options = common.served()
    tls: TlsParameters | None = options.pop("tls", None)
    places, chosen = with_server_preset(common.listeners, options)
    server: dict[str, Any] = {name: chosen.build(kind) for name, kind in _SERVER_KINDS.items()}
    listeners = [one if isinstance(one, Listener) else Listener(one) for one in places]
    return listeners, {**server, "tls": tls, "standard_port": chosen.build(UnitParameters).standard_port}


__all__ = [
    "COMMAND",
    "GatewayConfiguration",
    "load_gateway",
    "parse_gateway",
    "simple_gateway",
]
