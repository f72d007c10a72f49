"""Texts for socket addresses of clients: the host alone, or host and port."""


def host_of(address: object) -> str:
    """Return the host of a socket address; an address that is no tuple as text, empty for none."""
    return str(address[0]) if isinstance(address, tuple) and address else str(address or "")


def peer_name(address: object) -> str:
    """Return a socket address as text: ``host:port``, or ``[host]:port`` for IPv6; ``?`` if there is no address."""
    if isinstance(address, tuple) and len(address) >= 2:
        host, port = address[0], address[1]
        return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"
    return str(address or "?")
