"""Explains why a connection or listener could not use the network interface or local address that an option names.

Knows sockets, and the names of the two options; opens no connection. It is asked after a failure only.
"""

import errno
import socket

from ..errors import LinkDown
from ..values.unfit_values import shown
from .tcp import link_down

_MOST_NAMES = 8
"""Most network interfaces that a message names; a host with containers has hundreds."""
_FAMILIES = {socket.AF_INET: "IPv4", socket.AF_INET6: "IPv6"}


def connect_failure(
    error: BaseException, *, endpoint: str, host: str, local_address: str | None, interface: str | None = None
) -> LinkDown:
    """Return a `LinkDown` for a failed attempt to connect, with that error as its cause.

    If the option ``local_address`` or ``interface`` is at fault, the message names the option, its value and what to do
    about it, and the kind is ``local``.

    Args:
        error: the error of the attempt.
        endpoint: URL of the peer.
        host: host name or address of the peer.
        local_address: the value of the option; None if it is not given.
        interface: the value of the option; None if it is not given.
    """
    problem = interface_problem(error, interface) or _local_address_problem(error, host, local_address)
    if not problem:
        return link_down(error, endpoint=endpoint)
    down = LinkDown(f"no connection: {problem}", kind="local", endpoint=endpoint)
    down.__cause__ = error
    return down


def interface_problem(error: BaseException, interface: str | None) -> str:
    """Return in words why a socket could not be bound to a network interface; empty if that was not what failed.

    Args:
        error: the error of the attempt to listen or to connect.
        interface: name of the network interface; None if the option ``interface`` is not given.
    """
    if interface is None:
        return ""
    try:
        socket.if_nametoindex(interface)
    except (OSError, ValueError):
        return f"interface: {shown(interface)} does not exist on this host, which has {_interfaces()}"
    if getattr(error, "errno", None) == errno.EPERM:
        return f"interface: the system does not let this program use {shown(interface)}; it may need CAP_NET_RAW"
    return ""


def _interfaces() -> str:
    try:
        names = [name for _, name in socket.if_nameindex()]
    except OSError:
        names = []
    text = ", ".join(names[:_MOST_NAMES])
    return f"{text}…" if len(names) > _MOST_NAMES else text or "none"


def _local_address_problem(error: BaseException, host: str, local_address: str | None) -> str:
    """Return in words why a connection could not leave from a local address; empty if that was not what failed.

    A host name is not resolved for it: if the peer and the local address are both names, and one of them cannot be
    resolved, it is not known which one.
    """
    if local_address is None:
        return ""
    own, peer = _numeric(local_address), _numeric(host)
    if own is None:
        if not isinstance(error, socket.gaierror):
            return ""
        doubt = "" if peer else f", or the host {shown(host)},"
        return (
            f"local_address: {shown(local_address)}{doubt} cannot be resolved ({error.strerror}); "
            "give an address of this host, such as 192.168.1.5, or leave the option out"
        )
    family, address = own
    if peer is not None and peer[0] != family:
        return (
            f"local_address: {shown(local_address)} is {_FAMILIES[family]} and the host {host} is not; "
            "give an address of the same family, or leave the option out"
        )
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind(address)
    except OSError as reason:
        if reason.errno == errno.EADDRNOTAVAIL:
            return (
                f"local_address: {shown(local_address)} is no address of this host; "
                "give one that it has, or leave the option out"
            )
    return ""


def _numeric(host: str) -> tuple[socket.AddressFamily, tuple[object, ...]] | None:
    """Return family and socket address of a numeric host; None for a name."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST)[0]
    except (OSError, ValueError):
        return None
    return family, address
