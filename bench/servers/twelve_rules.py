"""A policy as an installation has it, for servers and gateways of the benchmark."""

import busway


def twelve_rules() -> busway.Policy:
    """As many as an installation has; the one that fits is the eleventh, and a window of registers."""
    others = [busway.Rule.of(units=unit, peers=["10.0.0.0/8"], name=f"unit {unit}") for unit in range(2, 12)]
    mine = busway.Rule.of(units=1, peers=["127.0.0.0/8"], table="holding", addresses="0-9999", name="mine")
    files = busway.Rule.of(action="read-only", files="1-4", name="files")
    return busway.Policy.of(*others, mine, files)
