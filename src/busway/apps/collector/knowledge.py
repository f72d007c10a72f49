"""What the collector has learnt about devices: refused ranges, largest reads and read costs; as values and as JSON.

Pure: knows no clock, no socket and no file.

1. Facts are learnt about a device by its name. They are dropped when the device gets another profile, firmware,
   endpoint or unit, unless they are pinned.
2. A new device begins with the facts that two devices with the same profile and firmware agree on.
3. A pinned fact is neither changed by learning nor forgotten with the others.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from ...codes import Table
from ...errors import ConfigError

VERSION: Final = 1
AGREEING: Final = 2
"""Number of devices of one kind that must agree on a fact before a new device of that kind begins with it."""


@dataclass(frozen=True, slots=True)
class LearntHole:
    """A range of registers or bits that a device was found to refuse, or a border that no read may cross.

    Attributes:
        table: the table of the range.
        start: the first refused register or bit, 0-based.
        end: the register or bit after the last refused one. For a border ``end`` equals ``start``, and the border is
            just before ``start``.
        code: the exception code that the device answered; 0 if it did not answer.
        pinned: whether the fact stays when learnt facts are forgotten, unless pinned facts are forgotten too.
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
    """The largest read that a device was found to answer, of bits or of registers.

    Attributes:
        bits: whether the limit is for bits; otherwise for registers.
        good: width of the widest read that succeeded.
        bad: width of the narrowest read that was refused because of its width.
        pinned: whether the fact stays when learnt facts are forgotten, unless pinned facts are forgotten too.
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
        profile: the device profile; empty for unknown.
        firmware: the firmware version that the collector file names; empty for unknown.
        base: seconds that each read takes apart from its registers; None if too few reads were made.
        holes: the ranges that the device refuses, and the borders that no read may cross.
        limits: the largest reads, at most one for registers and one for bits.
        place: endpoint and unit of the device when the facts were learnt, as text; empty for unknown.
        per_register: seconds that each register takes over a network; None if the baud rate determines it, or it is not
            known.
    """

    profile: str = ""
    firmware: str = ""
    base: float | None = None
    holes: tuple[LearntHole, ...] = ()
    limits: tuple[LearntLimit, ...] = ()
    place: str = ""
    per_register: float | None = None

    def limit(self, bits: bool) -> LearntLimit | None:
        """Return the learnt largest read of bits (``bits`` True) or of registers (False); None if none was learnt."""
        return next((one for one in self.limits if one.bits is bits), None)

    def refuses(self, table: Table, start: int, end: int) -> bool:
        """Whether a read of ``start`` … ``end - 1`` would touch a refused range or cross a border, as far as learnt."""
        return any(one.table is table and one.start < end and start < one.end for one in self.holes)

    def knows(self, hole: LearntHole) -> bool:
        """Whether this range, or a larger one around it, is known as refused; for a border, whether it is known.

        The exception code and ``pinned`` are not compared.
        """
        return any(
            one.table is hole.table
            and one.start <= hole.start
            and hole.end <= one.end
            and one.is_border is hole.is_border
            for one in self.holes
        )

    def with_hole(self, hole: LearntHole) -> "DeviceKnowledge":
        """Return a copy with one more refused range or border; the same object if it is already known."""
        if self.knows(hole):
            return self
        return replace(self, holes=(*self.holes, hole))

    def with_limit(self, limit: LearntLimit) -> "DeviceKnowledge":
        """Return a copy in which ``limit`` replaces the largest read of its kind (bits or registers).

        The same object is returned if the old limit is pinned, or equal.
        """
        known = self.limit(limit.bits)
        if known is not None and (known.pinned or known == limit):
            return self
        return replace(self, limits=(*(one for one in self.limits if one.bits is not limit.bits), limit))

    def pinned(self) -> "DeviceKnowledge":
        """Return a copy in which all holes and limits are pinned, so that `forgotten` keeps them by default."""
        return replace(
            self,
            holes=tuple(replace(one, pinned=True) for one in self.holes),
            limits=tuple(replace(one, pinned=True) for one in self.limits),
        )

    def forgotten(self, *, pinned: bool = False) -> "DeviceKnowledge":
        """Return a copy without the learnt facts and costs; profile, firmware, place and pinned facts are kept.

        Args:
            pinned: True to drop pinned facts too.
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
        """Yield what was learnt about the device, one sentence for each fact."""
        for hole in self.holes:
            yield f"{hole}{' (pinned)' if hole.pinned else ''}"
        for limit in self.limits:
            yield f"{limit}{' (pinned)' if limit.pinned else ''}"
        if self.base is not None:
            yield f"a read takes {1000 * self.base:.1f} ms apart from its registers"
        if self.per_register is not None:
            yield f"a register takes {1000 * self.per_register:.3g} ms"


class Knowledge:
    """The facts that the collector has learnt about all devices.

    Iterating gives pairs of device name and facts, sorted.

    Args:
        devices: facts known from before, by device; None for none.
    """

    def __init__(self, devices: Mapping[str, DeviceKnowledge] | None = None) -> None:
        self._devices = dict(devices or {})

    def __iter__(self) -> Iterator[tuple[str, DeviceKnowledge]]:
        return iter(sorted(self._devices.items()))

    def of(self, name: str, profile: str = "", firmware: str = "", place: str = "") -> DeviceKnowledge:
        """Return what is known about a device: from its own reads, or else from devices of its kind (rules 1 and 2).

        If profile, firmware or place has changed since the facts were learnt, only pinned facts are returned.

        Args:
            name: name of the device.
            profile: its device profile now.
            firmware: its firmware version now.
            place: its endpoint and unit now; empty if unknown, which is no change.
        """
        known = self._devices.get(name)
        if known is None:
            return replace(self.offered(profile, firmware), place=place)
        if (known.profile, known.firmware) != (profile, firmware) or known.place not in ("", place or known.place):
            known = replace(known.forgotten(), profile=profile, firmware=firmware)
        return replace(known, place=place or known.place)

    def set(self, name: str, known: DeviceKnowledge) -> None:
        """Replace all facts learnt about one device, or add those of a new device."""
        self._devices[name] = known

    def pin(self, name: str) -> bool:
        """Pin the facts learnt about a device, so that `forget` keeps them; return False if the device is not known."""
        return self._change(name, lambda known: known.pinned())

    def forget(self, name: str, *, pinned: bool = False) -> bool:
        """Forget the facts learnt about a device; return False if the device is not known.

        Args:
            name: name of the device.
            pinned: True to forget pinned facts too.
        """
        return self._change(name, lambda known: known.forgotten(pinned=pinned))

    def _change(self, name: str, change: Callable[[DeviceKnowledge], DeviceKnowledge]) -> bool:
        known = self._devices.get(name)
        if known is None:
            return False
        self._devices[name] = change(known)
        return True

    def offered(self, profile: str, firmware: str) -> DeviceKnowledge:
        """Return the facts that at least two devices with this profile and firmware agree on.

        For the largest read, two devices agree if both have learnt one; the smallest is returned. Empty if there are no
        such facts, or if profile or firmware is empty.
        """
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
        """Return the pairs of profile and firmware for which `offered` returns facts, sorted."""
        found = {(one.profile, one.firmware) for one in self._devices.values()}
        return sorted(kind for kind in found if any((self.offered(*kind).holes, self.offered(*kind).limits)))

    def text(self) -> str:
        """Return what was learnt about all devices as JSON, for `read_knowledge`."""
        return json.dumps(
            {"version": VERSION, "devices": {name: _device_data(known) for name, known in self}}, indent=1
        )


def read_knowledge(text: str, name: str) -> Knowledge:
    """Return the facts learnt about devices, from JSON that `Knowledge.text` has made.

    Args:
        text: the JSON.
        name: name of its file, for errors.

    Raises:
        ConfigError: the text is not such JSON, or is of another version.
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
