"""The configuration of a server and its clients from one file: every parameter, checked together (clause T33).

Knows what each section is for and which component takes it; knows no network. It reads its file and no other: a
component that needs a file named there (a certificate, the audit log) opens it. With ``preflight`` they are tried here.

>>> configuration = busway.load_configuration("plant.toml")          # doctest: +SKIP
>>> async with configuration.serve() as server: ...                  # doctest: +SKIP
>>> with configuration.connect("boiler") as link: ...                # doctest: +SKIP
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from ...access.addresses import AddressList
from ...access.rules import AccessRules, Policy
from ...config.certificates import tls_of
from ...config.file_text import read_text
from ...config.files.file_error import FileError
from ...config.files.key_lines import KeyPath
from ...config.files.system import SystemFile
from ...config.files.toml_source import read_source, with_unit
from ...config.links import NamedLink, named_links
from ...config.paths import rooted, within
from ...config.preflight import (
    check_exposure,
    check_files,
    check_listener_names,
    check_roles,
    check_unreached_rules,
)
from ...config.report import ConfigurationReport, nearest
from ...errors import ConfigError
from ...options.accepted_options import options_for
from ...options.declaration import declared
from ...options.endpoints import Endpoint, parse_endpoint
from ...options.server import ListenerParameters
from ...options.text import build_parameters
from ...options.tls import TlsParameters
from ...server.listener import Listener
from .reloadable_sections import SERVER_SECTIONS

if TYPE_CHECKING:
    from ...client.aio import AsyncLink
    from ...client.blocking import BlockingLink
    from ...server.server import Server


@dataclass(frozen=True, slots=True)
class Configuration:
    """The checked contents of a configuration file, as objects that can be served or opened.

    Attributes:
        name: path of the file, as it was given.
        file: the sections of the file.
        listeners: the listeners of the server, each with its own options.
        limits: limits and timeouts of listeners without their own.
        tls: TLS options of the listeners that have none of their own; None if ``[security]`` has no certificate.
        access: rules on what may be requested, and on who may connect; None without ``[policy]``.
        audit: path of the audit log; None if there is none.
        control: path or address of the control socket; None for the default one, or if ``[control]`` switches it off
            (``file.control_parameters.enabled`` is False).
        links: the links by name.
        warnings: warnings about the file, each with file, line and key.
        changes: options of all listeners, by name, that replace the file's.
        at_once: names of the sections whose changes a reload applies without a restart.
    """

    name: str
    file: SystemFile
    listeners: tuple[Listener, ...]
    limits: ListenerParameters
    tls: TlsParameters | None
    access: AccessRules | None
    audit: str | None
    control: str | None
    links: Mapping[str, NamedLink]
    warnings: tuple[ConfigError, ...]
    changes: Mapping[str, Any]
    at_once: frozenset[str] = SERVER_SECTIONS

    def serve(
        self, listen: Iterable[str | Listener] = (), **options: Any
    ) -> "Server":  # Any: as `busway.serve` takes them
        """Create a server for the units of the file, with its policy and address lists; the server is not started yet.

        Audit log, metrics and control socket of the file are not opened: `busway serve` does that, and a program opens
        those that it wants.

        Args:
            listen: endpoints, or `Listener`s, instead of the file's; empty to use the file's.
            options: options of `busway.serve`, instead of the file's.

        Raises:
            ConfigError: an endpoint or option is invalid, or the file has no unit, even if ``units`` are given.
        """
        from ...config.devices import build_units
        from ...server.serving import serve

        if not self.file.unit:
            raise ConfigError("there is no unit to serve", file=self.name, key="unit")
        units = options.pop("units", None) or build_units(self.file)
        return serve(
            *(tuple(listen) or self.listeners), **{"units": units, **self.served(), **self.guarded(), **options}
        )

    async def apply_to(
        self,
        running: object,
        listen: Sequence[Listener],
        *,
        policy: Policy | None,
        when_applied: Callable[[Sequence[str]], None],
    ) -> list[str]:
        """Call ``when_applied``, change nothing in a running server, and return an empty list.

        Policy, address lists and certificates are replaced by `Reload`; other changes of a server need a restart.
        """
        when_applied(())
        return []

    def served(self) -> dict[str, Any]:  # as `busway.serve` takes them
        """Return options of the file for `busway.serve`: TLS and the options of ``[server]``, with ``changes``.

        The policy, the address lists and the units of the file are not included.
        """
        chosen = self.file.server.options() | dict(self.changes)
        return chosen if self.tls is None else {**chosen, "tls": self.tls}

    def guarded(self) -> dict[str, Any]:  # as `busway.serve` takes them
        """Return policy and address lists of the file as options of `busway.serve`; empty without ``[policy]``."""
        return {} if self.access is None else {"policy": self.access.policy, "authorize": self.access.addresses}

    def open(self, name: str, *, shared: bool = True) -> "AsyncLink":
        """Return a link of the file for asyncio programs, as `busway.open` does.

        Args:
            name: name of the link.
            shared: whether the connection is shared with other links to the same endpoint, as of `busway.open`.

        Raises:
            ConfigError: there is no link of this name.
        """
        from ...client.aio import open_link

        link = self._link_to_open(name)
        return open_link(link.url, shared=shared, **link.options)

    def connect(self, name: str, *, shared: bool = True) -> "BlockingLink":
        """Return a link of the file for blocking programs, as `busway.connect` does.

        Args:
            name: name of the link.
            shared: whether the connection is shared with other links to the same endpoint, as of `busway.connect`.

        Raises:
            ConfigError: there is no link of this name.
        """
        from ...client.blocking import connect

        link = self._link_to_open(name)
        return connect(link.url, shared=shared, **link.options)

    def _link_to_open(self, name: str) -> NamedLink:
        """Return the declaration of a link that the caller is about to open. Raises `ConfigError` as `link` does.

        First sets the limit of this process's connections, if the file has one (``supported_connections``).
        """
        supported = self.file.client.supported_connections
        if supported is not None:
            from ...client.open_connections import limit_local_connections

            limit_local_connections(supported)
        return self.link(name)

    def link(self, name: str) -> NamedLink:
        """Return the declaration of a link: its URL and options. Nothing is opened.

        Raises:
            ConfigError: there is no link of this name; the message lists all names.
        """
        link = self.links.get(name)
        if link is None:
            there = f"there are {', '.join(self.links)}" if self.links else "there is none"
            raise ConfigError(f"there is no link {name!r}; {there}", file=self.name, key="link")
        return link


def load_configuration(
    path: str | os.PathLike[str], *, preflight: bool = False, changes: Mapping[str, Any] | None = None
) -> Configuration:
    """Load the configuration of a system from a file: server, listeners, links, security, policy and units.

    Args:
        path: path of the file, in TOML. Every device file is such a file.
        preflight: whether to open files that it names, too, such as certificates, so that their errors are found now.
        changes: options of all listeners, by name, that replace the file's.

    Raises:
        FileError: the file is invalid; ``problems`` has all errors, each with file, line and key.
        ConfigError: the file cannot be read.
    """
    name = os.fspath(path)
    return parse_configuration(read_text(name), name, preflight=preflight, changes=changes)


def parse_configuration(
    text: str,
    name: str,
    *,
    preflight: bool = False,
    changes: Mapping[str, Any] | None = None,
    unit: int | None = None,
) -> Configuration:
    """Parse the configuration of a system from a TOML text.

    Args:
        text: the contents of the file.
        name: path of the file, for errors; paths in the text are relative to its folder. The file is not read.
        preflight, changes: as of `load_configuration`.
        unit: number of the file's only ``[[unit]]`` if the text has none for it.

    Raises:
        FileError: the text is invalid; ``problems`` has all errors, each with file, line and key.
    """
    try:
        source = with_unit(read_source(text, name), unit)
        file = source.checked(SystemFile)
    except FileError as error:
        raise _what_reads_it(error) from None
    report = ConfigurationReport(source)
    made = put_together(file, name, report, preflight=preflight, changes=changes)
    return replace(made, warnings=report.end())


def _what_reads_it(error: FileError) -> FileError:
    """Return the error to raise for an invalid file.

    If the file has a key that only simulation files have, this is an error with the command that reads simulation
    files; otherwise it is ``error``.
    """
    from ...config.files.simulation import is_only_of_simulations

    one = next((each for each in error.problems if is_only_of_simulations(each.key or "")), None)
    if one is None:
        return error
    sentence = f"only simulation files have this; such a file is read by: busway simulate {one.file} --check"
    return FileError([ConfigError(sentence, file=one.file, line=one.line, key=one.key)])


def put_together(
    file: SystemFile,
    name: str,
    report: ConfigurationReport,
    *,
    preflight: bool = False,
    changes: Mapping[str, Any] | None = None,
    link_defaults: Mapping[str, Any] = MappingProxyType({}),
) -> Configuration:
    """Build the configuration of a file whose sections were checked one by one; errors go to a report, none is raised.

    Use the result only after `ConfigurationReport.end`, which raises the errors. ``warnings`` of the result is empty:
    the report has the warnings.

    Args:
        file: the sections of the file.
        name: path of the file; paths in it are relative to its folder.
        report: collects errors and warnings.
        preflight, changes: as of `load_configuration`.
        link_defaults: options of links whose defaults differ from the defaults of `busway.open`.
    """
    makers = _Makers(file, name, report, changes or {})
    limits = makers.limits()
    listeners = [makers.listener(place, parse_endpoint(url)) for place, url in file.places()]
    links = named_links(file, lambda options: rooted(options, name), report, link_defaults)
    check_roles(file, report)
    check_listener_names(file, report)
    access = None if file.policy is None else file.policy.access_rules()
    if access is not None:
        check_unreached_rules(access.policy.rules, report)
    if preflight:
        check_exposure(file, report)
        check_files(file, name, listeners, report)
    return Configuration(
        name,
        file,
        tuple(listeners),
        limits or ListenerParameters(),
        makers.tls(),
        access,
        None if file.audit_parameters is None else within(name, file.audit_parameters.path),
        _control(file, name),
        links,
        (),
        changes or {},
    )


def _control(file: SystemFile, name: str) -> str | None:
    control = file.control_parameters
    path = control.path
    if path is None or not control.enabled:
        return None
    is_address = path.startswith("http://") or path.rpartition(":")[2].isdecimal()
    return path if is_address else within(name, path)


class _Makers:
    """Builds the listeners of a file from its sections; invalid options are reported.

    Options of a single listener, in its section or its URL, override those of ``[server]`` and ``[security]``.
    """

    def __init__(self, file: SystemFile, name: str, report: ConfigurationReport, changes: Mapping[str, Any]) -> None:
        self._file = file
        self._name = name
        self._check_options = report
        self._changes = changes
        self._general = file.server.options()
        offered = options_for("server", TlsParameters)
        self._security = {key: value for key, value in file.security.options().items() if key in offered}

    def limits(self) -> ListenerParameters | None:
        """Return the limits and timeouts for listeners without their own; None if one is invalid, which is reported."""
        return self._limits({}, ("server",))

    def tls(self) -> TlsParameters | None:
        """Return the TLS options for listeners that have none of their own; None if the file has no certificate."""
        if self._security.get("certificate") is None:
            return None
        return build_parameters(TlsParameters, rooted(self._security, self._name))

    def _limits(self, own: Mapping[str, Any], at: KeyPath) -> ListenerParameters | None:
        known = declared(ListenerParameters)
        general = {key: value for key, value in self._general.items() if key in known}
        chosen = {**general, **own, **self._changes}

        def place(key: str | None) -> KeyPath:
            return nearest(key, own, at, general, ("server",))

        self._check_options.check_numbers(known, chosen, place)
        return self._check_options.make(lambda: build_parameters(ListenerParameters, chosen), place)

    def listener(self, place: KeyPath, endpoint: Endpoint) -> Listener:
        """Create a listener of the file. Invalid options are reported; the listener must then not be used.

        An invalid TLS option, access list or limit makes the whole group None: ``tls``, ``access`` or ``limits``.
        Invalid options in the URL stay in the URL; paths of certificates in it are joined to the file's folder.

        Args:
            place: path of its URL in the file, below ``listener`` or ``listen``.
            endpoint: the URL, parsed.
        """
        if endpoint.carrier == "serial":
            return self._checked(Listener(endpoint), place)
        endpoint = replace(endpoint, options=rooted(endpoint.options, self._name))
        section, at = (self._file.listener[int(place[1])], place[:2]) if place[0] == "listener" else (None, place)
        own = {} if section is None else section.options_of(TlsParameters)
        tls = self._tls(own, at) if endpoint.carrier == "tls" else None
        if section is None:
            return self._checked(Listener(endpoint, access=AddressList(), tls=tls), place)
        allow = section.allow if "allow" in section.model_fields_set else None
        access = self._check_options.make(
            lambda: AddressList(allow, section.deny, section.secure),
            lambda key: nearest(key, ("allow", "deny"), at, (), at),
        )
        own_limits = section.options_of(ListenerParameters)
        limits = self._limits(own_limits, at) if own_limits else None
        return self._checked(Listener(endpoint, access=access, tls=tls, limits=limits), place, own)

    def _checked(self, listener: Listener, place: KeyPath, own: Mapping[str, Any] | None = None) -> Listener:
        """Check the TLS options of a listener, report errors in them, and return the listener unchanged.

        Args:
            listener: the listener.
            place: path of its URL in the file.
            own: the options of its section; None if it has no section.
        """
        options = parse_endpoint(listener.endpoint).options

        def place_of(key: str | None) -> KeyPath:
            return place if key in options else nearest(key, own or {}, place[:2], self._security, ("security",))

        self._check_options.make(lambda: tls_of(listener), place_of)
        return listener

    def _tls(self, own: Mapping[str, Any], at: KeyPath) -> TlsParameters | None:
        chosen = rooted({**self._security, **own}, self._name)
        return self._check_options.make(
            lambda: build_parameters(TlsParameters, chosen),
            lambda key: nearest(key, own, at, self._security, ("security",)),
        )
