"""Which layer of the house a module of busway belongs to (docs/architecture.md)."""

LAYERS = {
    "codes": "L0",
    "errors": "L0",
    "pdu": "L1",
    "values": "L1",
    "framing": "L2",
    "session": "L3",
    "transport": "L4",
    "config": "L4",
    "client": "L5",
    "server": "L5",
    "observe": "L5",
    "gateway": "L6",
}
NAMES = {
    "L0": "codes and errors",
    "L1": "messages and stores' bytes (pdu, values)",
    "L2": "framing",
    "L3": "session",
    "L4": "transport, config",
    "L5": "drivers, handlers, stores, policy (client, server, observe)",
    "L6": "gateway",
    "": "event loop and Python's own",
}


def layer_of(module: str) -> str:
    """``L3`` for ``session/tcp_client.py``; empty for what is not in the house."""
    return LAYERS.get(module.partition("/")[0].removesuffix(".py"), "L5")
