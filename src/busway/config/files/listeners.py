"""Keys of files for listeners: their URLs and the options of their connections.

Knows keys and what goes with which scheme; knows no server. The values of limits are checked by the
server's own class when the configuration is put together (`busway.config`).
"""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, ClassVar, Final

from pydantic import AfterValidator, model_validator

from ...options.declaration import declared
from ...options.endpoints import parse_endpoint
from ...options.server import ListenerParameters
from ...options.tls import TlsParameters
from .key_lines import KeyPath
from .options import OptionSection, differing_from_url, with_options_of
from .policy import Hosts, RefusedHosts, Secure
from .section import NO_LIST, FileProblems


def _checked_url(url: str) -> str:
    parse_endpoint(url)
    return url


Url = Annotated[str, AfterValidator(_checked_url)]


@with_options_of(ListenerParameters, without={"shared_slots"})
@with_options_of(TlsParameters, role="server")
class ListenerSection(OptionSection):
    """``[[listener]]``: one address to listen on, with options that apply to it alone.

    Its limits override those of ``[server]``, its certificates those of ``[security]``; so do those of its URL.
    """

    checked_later: ClassVar[tuple[type[Any], ...]] = (TlsParameters, ListenerParameters)  # with those of [security]
    on_lines: ClassVar[frozenset[str]] = frozenset({"url"})
    """Names of the keys that have an effect on a serial line; the others are refused for such a listener."""

    url: Annotated[Url, "the endpoint to listen on."]
    allow: Hosts = NO_LIST
    deny: RefusedHosts = NO_LIST
    secure: Secure = None

    @model_validator(mode="after")
    def _check_scheme(self) -> "ListenerSection":
        endpoint = parse_endpoint(self.url)
        carrier = endpoint.carrier
        limits = declared(ListenerParameters)
        faults = list(differing_from_url(self, endpoint))
        for name in type(self).model_fields:
            if name in self.model_fields_set and name not in self.on_lines:
                if carrier == "serial":
                    faults.append(((name,), "has no effect on a serial line"))
                elif carrier != "tls" and name in declared(TlsParameters):
                    faults.append(((name,), "is for tls:// listeners"))
                elif name in limits and not limits[name].has_effect("server", endpoint.framing, carrier):
                    faults.append(((name,), f"has no effect on a {endpoint.scheme}:// listener"))
        if faults:
            raise FileProblems(faults)
        return self


def clashes(places: Sequence[tuple[KeyPath, str]]) -> Iterator[tuple[KeyPath, str]]:
    """Yield an error for each listener that uses the address and port, or the serial port, of an earlier one.

    Each error is the path of the later URL and a sentence. A host that means all addresses, such as ``0.0.0.0``,
    clashes with every address that it includes. Listeners of UDP never clash with those of TCP and TLS, nor those on
    port 0 with any. Host names are compared as texts, except ``localhost``, which is 127.0.0.1.

    Args:
        places: the path of each URL in the file, and the URL.
    """
    taken: dict[tuple[object, ...], dict[str, str]] = {}
    for path, url in places:
        endpoint = parse_endpoint(url)
        if endpoint.port == 0:
            continue
        if endpoint.carrier == "serial":
            others, host = taken.setdefault((endpoint.path,), {}), ""
        else:
            kind = "udp" if endpoint.carrier == "udp" else "tcp"
            others, host = taken.setdefault((kind, endpoint.port), {}), _ADDRESS_OF.get(endpoint.host, endpoint.host)
        clash = next((other for name, other in others.items() if name == host or _covers(name, host)), None)
        if clash is not None:
            yield path, f"{endpoint.url} is taken by {clash}"
        others.setdefault(host, endpoint.url)


_ADDRESS_OF: Final = {"localhost": "127.0.0.1"}
"""The address of a host name that every machine has."""
_ALL: Final = {"": "", "0.0.0.0": ".", "::": ":"}
"""Hosts that mean all addresses of this machine, each with a text that is in every address that it includes."""


def _covers(one: str, other: str) -> bool:
    """Return True if one of two hosts means all addresses (``0.0.0.0``, ``::`` or empty) and includes the other."""
    return (one in _ALL and _ALL[one] in other) or (other in _ALL and _ALL[other] in one)
