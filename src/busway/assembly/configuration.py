"""One object that holds every parameter of a system, checked as a whole (clause T33).

Knows what each section is for and which component takes it; knows no network. It reads its file and no other: what
the file names (certificates, the audit log) is opened by the component that it belongs to.

>>> configuration = busway.load_configuration("plant.toml")          # doctest: +SKIP
>>> async with configuration.serve() as server: ...                  # doctest: +SKIP
>>> with configuration.connect("boiler") as link: ...                # doctest: +SKIP
"""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..config.access.addresses import AddressList
from ..config.endpoints import Endpoint, parse_endpoint
from ..config.files.lines import Path as Place
from ..config.files.system import SystemFile, read_system_file
from ..config.options import build_parameters
from ..errors import ConfigError
from ..server.listener import Listener
from ..server.parameters import ListenerParameters
from ..transport.tls import OF_CLIENTS, TlsParameters
from .judging import Judge, nearest
from .links import NamedLink, named_links
from .reading import read_text

if TYPE_CHECKING:
    from ..client.aio import AsyncLink
    from ..client.blocking import Link
    from ..server.server import Server

ANY_ADDRESS = frozenset({"", "0.0.0.0", "::"})
"""Hosts of listeners that stand for every interface."""
TLS_FILES = frozenset({"certificate", "key", "password_file", "authority"})
"""Options that are paths."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """Everything that a configuration file says, checked as a whole.

    Attributes:
        name: the file's name.
        file: its sections.
        listeners: where a server of it listens, each with what holds there.
        links: the links by name.
        warnings: what is odd but can be, each with file, line and key.
    """

    name: str
    file: SystemFile
    listeners: tuple[Listener, ...]
    links: Mapping[str, NamedLink]
    warnings: tuple[ConfigError, ...]

    def serve(self, listen: Iterable[str] = (), **options: Any) -> "Server":  # Any: as `busway.serve` takes them
        """A server for the units of the file, not started yet.

        Args:
            listen: endpoints instead of those of the file.
            options: of `busway.serve`, instead of those of the file.

        Raises:
            ConfigError: an endpoint or option that can not be; the file has no unit.
        """
        from ..server.serving import serve
        from ..simulator.build import build_units

        if not self.file.unit:
            raise ConfigError("there is no unit to serve", file=self.name, key="unit")
        return serve(
            *(tuple(listen) or self.listeners), **{"units": build_units(self.file), **self.served(), **options}
        )

    def served(self) -> dict[str, Any]:  # as `busway.serve` takes them
        """The options of `busway.serve` that the file sets."""
        return self.file.server.options()

    def open(self, name: str, *, shared: bool = True) -> "AsyncLink":
        """A named link for asyncio programs, as `busway.open` gives it. Raises `ConfigError` if there is none."""
        from ..client.aio import open_link

        link = self.link(name)
        return open_link(link.url, shared=shared, **link.options)

    def connect(self, name: str, *, shared: bool = True) -> "Link":
        """A named link for blocking programs, as `busway.connect` gives it. Raises `ConfigError` if there is none."""
        from ..client.blocking import connect

        link = self.link(name)
        return connect(link.url, shared=shared, **link.options)

    def link(self, name: str) -> NamedLink:
        """What is declared of a link. Raises `ConfigError` that lists the names there are."""
        link = self.links.get(name)
        if link is None:
            there = f"there are {', '.join(self.links)}" if self.links else "there is none"
            raise ConfigError(f"there is no link {name!r}; {there}", file=self.name, key="client.link")
        return link


def load_configuration(path: str | os.PathLike[str]) -> Configuration:
    """The configuration of a file: server, listeners, client, security, policy and units.

    Args:
        path: the file, in TOML. Every device file is one.

    Raises:
        ConfigError: the file can not be read, or something in it can not be; then it has all ``problems``, each with
            file, line and key.
    """
    name = os.fspath(path)
    return parse_configuration(read_text(name), name)


def parse_configuration(text: str, name: str) -> Configuration:
    """The configuration that a text declares.

    Args:
        text: the content of the file.
        name: its name, for sentences; paths in it are relative to its folder.

    Raises:
        FileError: all that is wrong, each with file, line and key.
    """
    file, source = read_system_file(text, name)
    judge = Judge(source)
    listeners = _listeners(file, name, judge)
    links = named_links(file, lambda options: rooted(options, name), judge)
    return Configuration(name, file, tuple(listeners), links, judge.end())


def rooted(options: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Options whose paths are no longer relative to the folder of the file of a name."""
    return {key: within(name, value) if key in TLS_FILES else value for key, value in options.items()}


def within(name: str, path: str) -> str:
    """A path as the file of a name means it: relative to the file's folder."""
    return str(Path(name).parent / path)


def _listeners(file: SystemFile, name: str, judge: Judge) -> list[Listener]:
    """The listeners; what is wrong with one is told to the judge."""
    makers = _Makers(file, name, judge)
    return [made for place, url in file.places() if (made := makers.listener(place, parse_endpoint(url))) is not None]


class _Makers:
    """Makes listeners of what stands in a file: each part's own settings go before the general ones."""

    def __init__(self, file: SystemFile, name: str, judge: Judge) -> None:
        self._file = file
        self._name = name
        self._judge = judge
        self._limits = file.server.limits()
        self._security = {key: value for key, value in file.security.options().items() if key not in OF_CLIENTS}

    def listener(self, place: Place, endpoint: Endpoint) -> Listener | None:
        """The listener whose URL stands at a place."""
        if endpoint.host in ANY_ADDRESS and endpoint.carrier != "serial":
            self._judge.warn(place, f"{endpoint.url} listens on every interface of this host")
        section = self._file.listener[int(place[1])] if place[0] == "listener" else None
        at = place if section is None else place[:2]
        own = {} if section is None else section.limits()
        limits = self._judge.make(
            lambda: build_parameters(ListenerParameters, {**self._limits, **own}),
            lambda key: nearest(key, own, at, self._limits, ("server",)),
        )
        access = None
        if section is not None:
            access = self._judge.make(
                lambda: AddressList(section.allow, section.deny, section.secure),
                lambda key: nearest(key, ("allow", "deny"), at, (), at),
            )
        tls = None if endpoint.carrier != "tls" else self._tls({} if section is None else section.options(), at)
        return Listener(endpoint, access=access, tls=tls, limits=limits)

    def _tls(self, own: Mapping[str, Any], at: Place) -> TlsParameters | None:
        def make() -> TlsParameters:
            made = build_parameters(TlsParameters, rooted({**self._security, **own}, self._name))
            made.check_server()
            return made

        return self._judge.make(make, lambda key: nearest(key, own, at, self._security, ("security",)))
