"""Writes the table of fault profiles in docs/simulator.md from the code. With ``--check``: only compares.

Knows the fault profiles and the page; no word in the table is written by hand.
"""

from marked import ROOT, replaced, update

from busway.faults.profiles.not_simulated import NOT_SIMULATED
from busway.options.declaration import Option
from busway.testing import FAULT_PROFILES, Carrier, FaultProfile

PAGE = ROOT / "docs" / "simulator.md"

MET_ON = {
    frozenset(Carrier): "everything",
    frozenset({Carrier.TCP}): "Modbus TCP, TLS, UDP",
    frozenset({Carrier.SERIAL}): "RTU, ASCII; on a line or over a network",
    frozenset({Carrier.CONNECTION}): "connections: TCP, TLS, RTU and ASCII over TCP",
}


def render() -> str:
    """The tables: of what a server can play, and of what other products do."""
    lines = [
        "| fault profile | what happens | parameters | met on | seen in | a client that is up to it |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for one in FAULT_PROFILES.values():
        cells = (f"`{one.name}`", one.happens, parameters(one), MET_ON[one.carriers], seen(one.seen_in), one.answer)
        lines.append(f"| {' | '.join(cells)} |")
    lines += ["", "These are not faults of a server:", ""]
    lines += [
        "| fault profile | what happens | seen in | who is up to it | played by |",
        "| --- | --- | --- | --- | --- |",
    ]
    for other in NOT_SIMULATED.values():
        row = (f"`{other.name}`", other.happens, seen(other.seen_in), other.answer, other.played_by)
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


def parameters(fault_profile: FaultProfile) -> str:
    """The parameters of a fault profile in one cell."""
    return "<br>".join(parameter(one) for one in fault_profile.parameters.values())


def parameter(one: Option) -> str:
    """``delay`` = 1.5: seconds from request to reply (0…86400)."""
    given = "" if one.default is None else f" = {shown(one.default)}"
    return f"`{one.name}{given}`: {one.help}{f' ({one.limits})' if one.limits else ''}"


def shown(value: object) -> str:
    """A default as a file has it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float | int) else str(value)


def seen(places: tuple[str, ...]) -> str:
    """Where it was reported."""
    return ", ".join(places) or "–"


if __name__ == "__main__":
    update(PAGE, replaced(PAGE.read_text(encoding="utf-8"), "fault_profiles", render()))
