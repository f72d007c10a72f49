"""What the collector has learnt about devices: refused ranges, largest reads and read costs; as values and as JSON.

Pure: knows no clock, no socket and no file.

1. What was learnt belongs to a device. It is dropped when the device gets another profile or firmware, or its name
   stands for a unit at another place, unless it is pinned.
2. What two devices with the same profile and firmware learnt alike is offered to others of that kind: they begin
   with it.
3. What is pinned is neither changed by learning nor forgotten with the rest.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from ...codes import Table
from ...errors import ConfigError

VERSION: Final = 1
AGREEING: Final = 2
"""Devices that must have learnt the same before it is offered to others."""


@dataclass(frozen=True, slots=True)
class LearntHole:
    """A range of items that a device was found to refuse, or a border that no read may cross.

    Attributes:
        table: the table of the items.
        start, end: the first of them, and the one after the last; equal for the border before ``start``.
        code: the exception code that it answered; 0 for silence.
        pinned: whether it stays until it is forgotten by name.
    """

    table: Table
    start: int
    end: int
    code: int
    pinned: bool = False

    @property
    def is_border(self) -> bool:
        """Whether this is a border between two items that no read may cross, not a refused range."""
        return self.start == self.end

    def __str__(self) -> str:
        why = f"exception {self.code:02X}" if self.code else "silence"
        if self.is_border:
            return f"reads across the border before {self.table.label} {self.start}: {why}"
        last = f"…{self.end - 1}" if self.end - self.start > 1 else ""
        return f"{self.table.label} {self.start}{last}: {why}"


@dataclass(frozen=True, slots=True)
class LearntLimit:
    """The size of the largest read that a device was found to answer.

    Attributes:
        bits: whether it holds for bits; otherwise for registers.
        good: the widest read that succeeded.
        bad: the narrowest that was refused because of its width.
        pinned: whether it stays until it is forgotten by name.
    """

    bits: bool
    good: int
    bad: int
    pinned: bool = False

    def __str__(self) -> str:
        return f"at most {self.good} {'bits' if self.bits else 'registers'} in one read; {self.bad} are refused"


@dataclass(frozen=True, slots=True)
class DeviceKnowledge:
    """What the collector has learnt about one device: refused ranges, largest reads, cost of reads.

    Attributes:
        profile, firmware: what kind of device it is; empty for unknown.
        base: seconds of a read apart from its registers; None where too few reads were made.
        holes: the ranges it refuses to read.
        limits: the widest reads, one for registers and one for bits at most.
        place: endpoint and unit where it was learnt; empty for unknown.
        per_register: seconds of a register, behind a network; None where the line says that, or it is not known.
    """

    profile: str = ""
    firmware: str = ""
    base: float | None = None
    holes: tuple[LearntHole, ...] = ()
    limits: tuple[LearntLimit, ...] = ()
    place: str = ""
    per_register: float | None = None

    def limit(self, bits: bool) -> LearntLimit | None:
        """Return the largest read of bits, or of registers, that was learnt; None without one."""
        return next((one for one in self.limits if one.bits is bits), None)

    def refuses(self, table: Table, start: int, end: int) -> bool:
        """Whether a read would touch a range that the device was found to refuse."""
        return any(one.table is table and one.start < end and start < one.end for one in self.holes)

    def knows(self, hole: LearntHole) -> bool:
        """Whether the device is already known to refuse this range, or a larger one around it."""
        return any(
            one.table is hole.table
            and one.start <= hole.start
            and hole.end <= one.end
            and one.is_border is hole.is_border
            for one in self.holes
        )

    def with_hole(self, hole: LearntHole) -> "DeviceKnowledge":
        """Return a copy with one more range that the device refuses."""
        if self.knows(hole):
            return self
        return replace(self, holes=(*self.holes, hole))

    def with_limit(self, limit: LearntLimit) -> "DeviceKnowledge":
        """Return a copy with another largest read, unless the present one is pinned (protected from change)."""
        known = self.limit(limit.bits)
        if known is not None and (known.pinned or known == limit):
            return self
        return replace(self, limits=(*(one for one in self.limits if one.bits is not limit.bits), limit))

    def pinned(self) -> "DeviceKnowledge":
        """Return a copy in which all facts are pinned, so that only an explicit command forgets them."""
        return replace(
            self,
            holes=tuple(replace(one, pinned=True) for one in self.holes),
            limits=tuple(replace(one, pinned=True) for one in self.limits),
        )

    def forgotten(self, *, pinned: bool = False) -> "DeviceKnowledge":
        """Return a copy with only pinned facts (kept by the user's will); if ``pinned`` are to be forgotten too, an
        empty one.
        """
        return DeviceKnowledge(
            self.profile,
            self.firmware,
            None,
            tuple(one for one in self.holes if one.pinned and not pinned),
            tuple(one for one in self.limits if one.pinned and not pinned),
            self.place,
        )

    def lines(self) -> Iterator[str]:
        """Return what was learnt about the device as sentences."""
        for hole in self.holes:
            yield f"{hole}{' (pinned)' if hole.pinned else ''}"
        for limit in self.limits:
            yield f"{limit}{' (pinned)' if limit.pinned else ''}"
        if self.base is not None:
            yield f"a read takes {1000 * self.base:.1f} ms apart from its registers"
        if self.per_register is not None:
            yield f"a register takes {1000 * self.per_register:.3g} ms"


class Knowledge:
    """What the collector has learnt about each device: refused ranges, largest reads, cost of reads."""

    def __init__(self, devices: Mapping[str, DeviceKnowledge] | None = None) -> None:
        self._devices = dict(devices or {})

    def __iter__(self) -> Iterator[tuple[str, DeviceKnowledge]]:
        return iter(sorted(self._devices.items()))

    def of(self, name: str, profile: str = "", firmware: str = "", place: str = "") -> DeviceKnowledge:
        """Return what is known about a device: from its own reads, or else from devices of its kind (rules 1 and 2)."""
        known = self._devices.get(name)
        if known is None:
            return replace(self.offered(profile, firmware), place=place)
        if (known.profile, known.firmware) != (profile, firmware) or known.place not in ("", place or known.place):
            known = replace(known.forgotten(), profile=profile, firmware=firmware)
        return replace(known, place=place or known.place)

    def set(self, name: str, known: DeviceKnowledge) -> None:
        """Replace the facts learnt about one device."""
        self._devices[name] = known

    def pin(self, name: str) -> bool:
        """Pin what was learnt about a device, so that `forget` keeps it. Returns False if the device is unknown."""
        return self._change(name, lambda known: known.pinned())

    def forget(self, name: str, *, pinned: bool = False) -> bool:
        """Forget what was learnt about a device; facts pinned by the user only if asked. Returns False if it is
        unknown.
        """
        return self._change(name, lambda known: known.forgotten(pinned=pinned))

    def _change(self, name: str, change: Callable[[DeviceKnowledge], DeviceKnowledge]) -> bool:
        known = self._devices.get(name)
        if known is None:
            return False
        self._devices[name] = change(known)
        return True

    def offered(self, profile: str, firmware: str) -> DeviceKnowledge:
        """Return the facts that at least two devices with the same profile and firmware have learnt independently."""
        empty = DeviceKnowledge(profile, firmware)
        if not profile or not firmware:
            return empty
        same = [one for one in self._devices.values() if (one.profile, one.firmware) == (profile, firmware)]
        holes = {(hole.table, hole.start, hole.end): hole for one in same for hole in one.holes}
        agreed = [
            replace(hole, pinned=False) for hole in holes.values() if sum(one.knows(hole) for one in same) >= AGREEING
        ]
        limits = {replace(limit, pinned=False) for one in same for limit in one.limits}
        both = [limit for limit in limits if sum(one.limit(limit.bits) is not None for one in same) >= AGREEING]
        narrowest = {limit.bits: limit for limit in sorted(both, key=lambda limit: -limit.good)}
        return replace(
            empty,
            holes=tuple(sorted(agreed, key=lambda hole: (hole.table.value, hole.start, hole.end))),
            limits=tuple(narrowest[bits] for bits in sorted(narrowest)),
        )

    def kinds(self) -> list[tuple[str, str]]:
        """Return the kinds of devices (profile, firmware) of which two devices or more have learnt the same."""
        found = {(one.profile, one.firmware) for one in self._devices.values()}
        return sorted(kind for kind in found if any((self.offered(*kind).holes, self.offered(*kind).limits)))

    def text(self) -> str:
        """Return what was learnt about all devices as JSON."""
        return json.dumps(
            {"version": VERSION, "devices": {name: _device_data(known) for name, known in self}}, indent=1
        )


def read_knowledge(text: str, name: str) -> Knowledge:
    """Return what was learnt about devices from the JSON that `Knowledge.text` has written.

    Raises:
        ConfigError: the text is something else; names the file.
    """
    try:
        data = json.loads(text)
        if data["version"] != VERSION:
            raise ConfigError(f"has version {data['version']}; this program reads version {VERSION}", file=name)
        return Knowledge({device: _device(each) for device, each in data["devices"].items()})
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(
            f"does not hold what a collector learnt ({error!r}); remove the file to learn anew", file=name
        ) from error


def _device_data(known: DeviceKnowledge) -> dict[str, Any]:  # Any: what JSON has
    return {
        "profile": known.profile,
        "firmware": known.firmware,
        "place": known.place,
        "base": known.base,
        "per_register": known.per_register,
        "holes": [
            {"table": one.table.value, "start": one.start, "end": one.end, "code": one.code, "pinned": one.pinned}
            for one in known.holes
        ],
        "limits": [
            {"of": "bits" if one.bits else "registers", "good": one.good, "bad": one.bad, "pinned": one.pinned}
            for one in known.limits
        ],
    }


def _device(data: Mapping[str, Any]) -> DeviceKnowledge:  # Any: what JSON has
    return DeviceKnowledge(
        str(data["profile"]),
        str(data["firmware"]),
        None if data["base"] is None else float(data["base"]),
        tuple(
            LearntHole(Table(one["table"]), int(one["start"]), int(one["end"]), int(one["code"]), bool(one["pinned"]))
            for one in data["holes"]
        ),
        tuple(
            LearntLimit(one["of"] == "bits", int(one["good"]), int(one["bad"]), bool(one["pinned"]))
            for one in data["limits"]
        ),
        str(data.get("place", "")),
        None if data.get("per_register") is None else float(data["per_register"]),
    )
