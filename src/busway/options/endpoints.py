"""Endpoints: URLs that say where a peer or a serial line is, and how it is spoken to.

Knows the grammar of the URLs and the schemes; knows no transport. Options are not checked here: the component for which
the URL is meant checks them, and reports options that it does not have.

::

    tcp://host[:502]   tls://host[:802]   udp://host[:502]
    rtu:///dev/ttyUSB0?baud=19200&parity=even     ascii:///dev/ttyS1
    rtu+tcp://host:4001   ascii+tcp://host:4001   rtu+udp://host:4001   ascii+udp://host:4001

An empty host means every interface for a listener; a client refuses it (`require_host`).

An IP address without a scheme is tcp. Any other text without one is refused with a suggested URL: the name of a serial
port does not say whether its framing is RTU or ASCII.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final
from urllib.parse import parse_qsl, quote, unquote, urlsplit

from ..codes import DEFAULT_TCP_PORT, DEFAULT_TLS_PORT
from ..errors import ConfigError
from ..values.similar_names import similar_name
from ..values.unfit_values import shown


@dataclass(frozen=True, slots=True)
class Scheme:
    """A URL scheme, such as ``tcp``.

    Attributes:
        framing: ``mbap``, ``rtu`` or ``ascii``.
        carrier: the transport: ``tcp``, ``tls``, ``udp`` or ``serial``.
        default_port: port of URLs that name none; None if they must name one, or have none.
    """

    framing: str
    carrier: str
    default_port: int | None = None


SCHEMES: dict[str, Scheme] = {
    "tcp": Scheme("mbap", "tcp", DEFAULT_TCP_PORT),
    "tls": Scheme("mbap", "tls", DEFAULT_TLS_PORT),
    "udp": Scheme("mbap", "udp", DEFAULT_TCP_PORT),
    "rtu": Scheme("rtu", "serial"),
    "ascii": Scheme("ascii", "serial"),
    "rtu+tcp": Scheme("rtu", "tcp"),
    "ascii+tcp": Scheme("ascii", "tcp"),
    "rtu+udp": Scheme("rtu", "udp"),
    "ascii+udp": Scheme("ascii", "udp"),
}

EVERY_ADDRESS: Final = frozenset({"", "0.0.0.0", "::"})
"""Hosts of a listener's URL that mean every address of this machine."""

# Texts, and compiled where they are used: a URL with a scheme needs none of them.
_ADDRESS = r"(?:[0-9]{1,3}(?:\.[0-9]{1,3}){3}|\[[0-9A-Fa-f:.]*:[0-9A-Fa-f:.%\w]*\])(?::[0-9]{1,5})?/?"
_BARE_IPV6 = r"[0-9A-Fa-f]*:[0-9A-Fa-f]*:[0-9A-Fa-f:.]*"
_PORT_NAME = r"[Cc][Oo][Mm][0-9]{1,3}|/dev/.+"
_HALF_A_SCHEME = r"(?P<scheme>[A-Za-z+]+):/*(?P<rest>[^/].*)"
_HOST_NAME = r"[A-Za-z0-9_-]+(?:\.[A-Za-z0-9_-]+)*\.?(?::[0-9]{1,5})?"
_OTHER_NAMES = {
    "modbus": "tcp",
    "modbus+tcp": "tcp",
    "modbustcp": "tcp",
    "mbap": "tcp",
    "modbus+udp": "udp",
    "modbus+rtu": "rtu",
    "serial": "rtu",
}
"""Schemes of other programs, each with the scheme that errors suggest instead."""

_HOST = re.compile(r"^[A-Za-z0-9._~%-]*$|^\[[0-9A-Fa-f:.%\w]+\]$")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A parsed URL that says where a peer or serial line is, and how it is spoken to.

    Attributes:
        scheme: one of the keys of `SCHEMES`.
        host: name or address, in lower case, IPv6 without brackets; empty if the URL has none.
        port: 0…65535; 0 lets a listener choose a free one. None for serial ports.
        path: device path of a serial port; empty otherwise.
        options: the options after ``?``, by name (with ``_`` for ``-``), as texts.
    """

    scheme: str
    host: str = ""
    port: int | None = None
    path: str = ""
    options: Mapping[str, str] = field(default_factory=dict, hash=False)

    @property
    def framing(self) -> str:
        """The framing that the scheme of the URL means: ``mbap``, ``rtu`` or ``ascii``."""
        return SCHEMES[self.scheme].framing

    @property
    def carrier(self) -> str:
        """The transport that the scheme of the URL means: ``tcp``, ``tls``, ``udp`` or ``serial``."""
        return SCHEMES[self.scheme].carrier

    @property
    def url(self) -> str:
        """The URL without options. It names the endpoint in messages.

        Endpoints with equal URLs are the same endpoint.
        """
        if self.carrier == "serial":
            return f"{self.scheme}://{quote(self.path, safe='/:')}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}"

    def __str__(self) -> str:
        if not self.options:
            return self.url
        query = "&".join(f"{quote(name)}={quote(value)}" for name, value in self.options.items())
        return f"{self.url}?{query}"


_LONGEST = 1024
"""Longest URL, or part of one, in characters, that errors show in full; of longer ones they show 60."""


def parse_endpoint(url: "str | Endpoint") -> Endpoint:
    """Parse a URL; an IP address alone is ``tcp://``, and an `Endpoint` is returned unchanged.

    Names and values of options are not checked. No connection is made.

    Raises:
        ConfigError: the text is no URL of an endpoint, or gives an option twice; where possible the error suggests a
            URL.
    """
    if isinstance(url, Endpoint):
        return url
    if not isinstance(url, str):
        raise ConfigError(f"{shown(url)} is no endpoint; write for example tcp://192.168.0.5 or rtu:///dev/ttyUSB0")
    if "://" not in url:
        url = _with_scheme(url)
    scheme, _, rest = url.partition("://")
    scheme = scheme.lower()
    name = _cut(url)
    if scheme not in SCHEMES:
        raise ConfigError(f"{name}: unknown scheme {_cut(scheme)!r}; {_hint_of_scheme(scheme, _cut(rest))}")
    try:
        parts = urlsplit(url)
    except ValueError:
        raise ConfigError(f"{name}: an IPv6 address stands in brackets, as in {scheme}://[fe80::1]") from None
    try:
        port = parts.port
    except ValueError:
        if parts.netloc.count(":") > 1 and "[" not in parts.netloc:
            raise ConfigError(f"{name}: an IPv6 address stands in brackets, as in {scheme}://[fe80::1]") from None
        given = _cut(parts.netloc.rpartition(":")[2])
        raise ConfigError(f"{name}: the port must be 0…65535, not {given!r}") from None
    if parts.fragment:
        raise ConfigError(f"{name}: an endpoint has no #{_cut(parts.fragment)}")
    if parts.username is not None:
        raise ConfigError(f"{name}: an endpoint has no user name")
    options = _options(url, parts.query)
    rule = SCHEMES[scheme]
    if rule.carrier == "serial":
        path = parts.path
        if re.fullmatch(_PORT_NAME, parts.netloc) and path in ("", "/"):
            path = f"/{parts.netloc}"
        elif parts.netloc:
            meant = rest if rest.startswith("dev/") else f"dev/{rest}"
            raise ConfigError(
                f"{name}: a serial line is {scheme}:///dev/… with three slashes; is it {scheme}:///{_cut(meant)}?"
            )
        if len(path) < 2:
            raise ConfigError(f"{name}: the path of the serial port is missing, as in {scheme}:///dev/ttyUSB0")
        return Endpoint(scheme, path=unquote(path), options=options)
    if parts.path not in ("", "/"):
        raise ConfigError(f"{name}: a network endpoint has no path {_cut(parts.path)}")
    netloc = parts.netloc.rsplit(":", 1)[0] if port is not None or parts.netloc.endswith(":") else parts.netloc
    if not _HOST.match(netloc):
        raise ConfigError(f"{name}: {_cut(netloc)!r} is no host name or address (IPv6 goes in brackets)")
    port = rule.default_port if port is None else port
    if port is None:
        raise ConfigError(f"{name}: the port is missing; {scheme} has no usual one")
    return Endpoint(scheme, host=parts.hostname or "", port=port, options=options)


def require_host(endpoint: Endpoint) -> None:
    """Raise `ConfigError` if a network endpoint has no host, so that a client has no peer to connect to."""
    if endpoint.carrier != "serial" and not endpoint.host:
        raise ConfigError(f"{endpoint.url}: the host is missing, as in {endpoint.scheme}://127.0.0.1:{endpoint.port}")


def _cut(text: str) -> str:
    """Return a URL, or a part of one, as errors show it: long ones are cut."""
    return f"{text[:60]}…" if len(text) > _LONGEST else text


def _with_scheme(text: str) -> str:
    """Return the ``tcp://`` URL for an IP address without a scheme, which may have a port and options.

    Raises:
        ConfigError: the text is no IP address; the error suggests a URL.
    """
    place, mark, query = text.strip().partition("?")
    if re.fullmatch(_ADDRESS, place):
        return f"tcp://{place}{mark}{query}"
    if re.fullmatch(_BARE_IPV6, place):
        return f"tcp://[{place}]{mark}{query}"
    raise ConfigError(f"{_cut(text)!r} is no endpoint; {_hint_of_text(_cut(place))}")


def _hint_of_text(place: str) -> str:
    if (half := re.fullmatch(_HALF_A_SCHEME, place)) and (scheme := half["scheme"].lower()) in SCHEMES:
        slashes = ":///" if SCHEMES[scheme].carrier == "serial" else "://"
        return f"is it {scheme}{slashes}{half['rest']}?"
    if re.fullmatch(_PORT_NAME, place) or place.lower().startswith("usb:"):
        path = place.lstrip("/")
        return f"is it rtu:///{path}, or ascii:///{path}?"
    if re.fullmatch(_HOST_NAME, place):
        return f"is it tcp://{place}? A serial port is written rtu:///dev/ttyUSB0"
    return "write for example tcp://192.168.0.5 or rtu:///dev/ttyUSB0"


def _hint_of_scheme(scheme: str, rest: str) -> str:
    meant = _OTHER_NAMES.get(scheme) or similar_name(scheme, SCHEMES)
    return f"there are {', '.join(SCHEMES)}" if meant is None else f"is it {meant}://{rest}?"


def _options(url: str, query: str) -> dict[str, str]:
    options: dict[str, str] = {}
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
    except ValueError:
        raise ConfigError(f"{_cut(url)}: the options behind ? are name=value pairs joined by &") from None
    for name, value in pairs:
        name = name.replace("-", "_")
        if name in options:
            raise ConfigError(f"{_cut(url)}: the option {_cut(name)} is given twice", key=_cut(name))
        options[name] = value
    return options
