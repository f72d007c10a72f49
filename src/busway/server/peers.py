"""Names of peers from socket addresses."""


def host_of(address: object) -> str:
    """The host part of a socket address; for other kinds of addresses their text."""
    return str(address[0]) if isinstance(address, tuple) and address else str(address or "")


def peer_name(address: object) -> str:
    """A socket address as text: ``host:port``, or ``[host]:port`` for IPv6."""
    if isinstance(address, tuple) and len(address) >= 2:
        host, port = address[0], address[1]
        return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"
    return str(address or "?")
