"""Names of peers from socket addresses."""


def host_of(address: object) -> str:
    """The host of a socket address, without port; the text of anything else."""
    return str(address[0]) if isinstance(address, tuple) and address else str(address or "")


def peer_name(address: object) -> str:
    """``host:port`` of a socket address, ``[host]:port`` for IPv6."""
    if isinstance(address, tuple) and len(address) >= 2:
        host, port = address[0], address[1]
        return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"
    return str(address or "?")
