"""Writes the tables of registers in docs/gateway.md from the map of the gateway's own unit. ``--check``: only compares.

Knows the map; knows no gateway.
"""

from collections.abc import Sequence

from marked import ROOT, replaced, update

from busway.apps.gateway.own_unit import FIRST_UPSTREAM, REGISTERS, UPSTREAM_REGISTERS, StatusRegister


def render(entries: Sequence[StatusRegister], start: int, label: str) -> str:
    """A table of registers; ``label`` stands before the offset in an upstream's block."""
    lines = ["| offset | notation | type | value | |", "| --- | --- | --- | --- | --- |"]
    for entry in entries:
        kind = "uint32" if entry.registers == 2 else "uint16"
        offset = f"{label}{entry.address}"
        lines.append(f"| {offset} | `3x{start + entry.address + 1}` | {kind} | `{entry.name}` | {entry.meaning} |")
    return "\n".join(lines)


if __name__ == "__main__":
    file = ROOT / "docs" / "gateway.md"
    page = file.read_text(encoding="utf-8")
    page = replaced(page, "own", render(REGISTERS, 0, ""))
    page = replaced(page, "upstreams", render(UPSTREAM_REGISTERS, FIRST_UPSTREAM, f"{FIRST_UPSTREAM} + "))
    update(file, page)
