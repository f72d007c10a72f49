"""What samples of `lying_devices` have to be: a layout of points, and a checker that knows who was asked what.

1. A sample that is good equals what its device held at its point in an answer within the sample's transaction.
2. A series is a point of a device with its history: a rename carries it on, a point under an old name goes on with what
   has that name. From one configuration to the next each series changes its source once, and not back.
3. Values of computed and scaled points are of no single answer: they have to be those of the device of that time.
"""

import bisect
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from lying_devices import SCALES, Answer, bit, word

TOLERANCE = 30_000_000
"""Nanoseconds between the clock of the devices and that of the samples: what a busy machine makes of it."""
ORDERS = ("ABCDEFGH", "GHEFCDAB", "BADCFEHG", "HGFEDCBA")
GROUP = 1100


@dataclass(frozen=True, slots=True)
class Laid:
    """A point of a layout: how a file declares it, what has to be asked for it, and what it then is."""

    key: str
    text: str
    function: int
    start: int
    count: int
    value: Callable[[int, int, int], object]
    """From device, first item and turn."""
    is_timeless: bool = False
    """Whether it is computed from several answers."""
    moves: bool = True
    """Whether the parameter ``base`` of the profile moves it."""


def code(order: str, function: int = 3) -> Callable[[int, int, int], object]:
    """A whole number of 64 bits from four registers, as an order of bytes has it."""

    def value(device: int, start: int, turn: int) -> object:
        raw = b"".join(word(device, function, start + n, turn).to_bytes(2, "big") for n in range(4))
        return int.from_bytes(bytes(raw[order.index(letter)] for letter in "ABCDEFGH"), "big")

    return value


def _first(device: int, start: int, turn: int) -> int:
    return word(device, 3, start, turn)


def layout(blocks: Sequence[int] = (0, 4, 8, 24, 28, 60, 100, 108, 200)) -> list[Laid]:
    """Points of every kind over some blocks of four registers."""
    points = []
    for number, block in enumerate(blocks):
        order = ORDERS[number % 4]
        at = f'"holding:${{base + {block}}}"'
        text = f'address = {at}, type = "uint64", order = "{order}", overlaps = true'
        points.append(Laid(f"code{block}", text, 3, block, 4, code(order)))
    points += [
        Laid("dev0", 'address = "holding:${base}", overlaps = true', 3, 0, 1, _first),
        Laid("dev60", 'address = "holding:${base + 60}", overlaps = true', 3, 60, 1, _first),
        Laid(
            "low8",
            'address = "holding:${base + 8}.0-7", overlaps = true',
            3,
            8,
            1,
            lambda device, start, turn: device & 0xFF,
        ),
        Laid(
            "odd",
            'address = "holding:${base + 27}.0", overlaps = true',
            3,
            27,
            1,
            lambda device, start, turn: bool(turn & 1),
        ),
        Laid("inputs", 'address = "input:${base + 16}", type = "uint64"', 4, 16, 4, code("ABCDEFGH", 4)),
        Laid("coil0", 'address = "coil:${base}"', 1, 0, 1, bit),
        Laid("coil16", 'address = "coil:${base + 16}"', 1, 16, 1, bit),
        Laid("discrete1", 'address = "discrete:${base + 1}"', 2, 1, 1, bit),
        Laid("exponent", f'address = "holding:{SCALES + 1}"', 3, SCALES + 1, 1, _first, moves=False),
        Laid("places", f'address = "holding:{SCALES + 2}"', 3, SCALES + 2, 1, _first, moves=False),
        Laid(
            "scaled",
            'address = "holding:${base + 60}", scale_from = "exponent", overlaps = true',
            3,
            60,
            1,
            lambda device, start, turn: device * 10 ** (device % 4),
            is_timeless=True,
        ),
        Laid(
            "computed",
            'formula = "dev0 * 2 + dev60"',
            3,
            0,
            1,
            lambda device, start, turn: 3 * device,
            is_timeless=True,
        ),
    ]
    return points


def group_points(most: int = 4) -> list[Laid]:
    """The members of the repeating group of `profile`; `Laid.text` is empty."""
    members = []
    for place in range(1, most + 1):
        start = GROUP + 4 * (place - 1)
        members.append(Laid(f"string.{place}.code", "", 3, start, 4, code("ABCDEFGH"), moves=False))
        members.append(Laid(f"string.{place}.half", "", 3, start, 1, _first, moves=False))
        members.append(
            Laid(
                f"string.{place}.sum",
                "",
                3,
                start,
                1,
                lambda device, start, turn: device + 1 + device % 4,
                is_timeless=True,
                moves=False,
            )
        )
    return members


def profile(
    points: Iterable[Laid], names: Mapping[str, str], was: Mapping[str, str], *, read: str = "bridge = true"
) -> str:
    """A profile with these points: their names and former names by key."""
    lines = ["[parameters]", "base = 0", "[[unit]]", "unit = 1", f"read = {{ {read} }}", "point = ["]
    for point in points:
        former = f', was = "{was[point.key]}"' if point.key in was else ""
        lines.append(f'    {{ name = "{names.get(point.key, point.key)}", {point.text}{former} }},')
    lines += [
        "]",
        "[[unit.group]]",
        'name = "string"',
        "count = 4",
        'count_from = "places"',
        "stride = 4",
        "atomic = true",
        "point = [",
        f'    {{ name = "code", address = "holding:{GROUP}", type = "uint64", overlaps = true }},',
        f'    {{ name = "half", address = "holding:{GROUP}", overlaps = true }},',
        '    { name = "sum", formula = "half + places" },',
        "]",
    ]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True, slots=True)
class Source:
    """Where the samples of a series come from: a point of a device of the field."""

    device: int
    laid: Laid
    base: int

    def start(self) -> int:
        return self.laid.start + (self.base if self.laid.moves else 0)


@dataclass(slots=True)
class Epoch:
    """A configuration, and between which times it came into force."""

    earliest: int
    latest: int
    sources: Mapping[int, Source]


@dataclass(slots=True)
class Truth:
    """What every series is, over all configurations so far."""

    epochs: list[Epoch] = field(default_factory=list)
    series: dict[tuple[str, str], int] = field(default_factory=dict)
    made: int = 0

    def configure(
        self,
        points: Mapping[tuple[str, str], Source],
        was: Mapping[tuple[str, str], str],
        earliest: int,
        latest: int,
    ) -> None:
        """Another configuration: by names of device and point where it comes from, and its former name."""
        before = dict(self.series)
        for device, former in was.items():
            if device not in before and (device[0], former) in before:
                self.series[device] = before[device[0], former]
                self.series.pop((device[0], former), None)
        sources = {}
        for name, source in points.items():
            if name not in self.series:
                self.series[name] = self.made = self.made + 1
            sources[self.series[name]] = source
        self.epochs.append(Epoch(earliest, latest, sources))

    def in_force(self, begin: int, end: int) -> list[int]:
        """The configurations that may have been in force between these times."""
        return [
            number
            for number, epoch in enumerate(self.epochs)
            if epoch.earliest <= end and (number + 1 == len(self.epochs) or self.epochs[number + 1].latest >= begin)
        ]


class Checker:
    """Samples against what devices answered; what is wrong is collected in ``wrong``."""

    def __init__(self, truth: Truth, answers: Mapping[int, Sequence[Answer]]) -> None:
        self._truth = truth
        self._answers = {device: sorted(list_, key=lambda a: a.received) for device, list_ in answers.items()}
        self._received = {device: [a.received for a in list_] for device, list_ in self._answers.items()}
        self.wrong: list[str] = []
        self.good = 0
        self.checked = 0

    def check(self, samples: Iterable[Any]) -> None:  # Any: a row of a store, or of `samples()`
        """All samples of the store, by the names that hold at the end."""
        last: dict[int, int] = {}
        for sample in sorted(samples, key=lambda each: each.time):
            self.checked += 1
            series = self._truth.series.get((sample.device, sample.point))
            if series is None:
                self.wrong.append(f"{sample}: no such point")
            elif sample.value is not None:
                self.good += sample.reason == 0
                self._check(sample, series, last)

    def _check(self, sample: Any, series: int, last: dict[int, int]) -> None:
        begin = sample.time - sample.half_width - TOLERANCE
        end = sample.time + sample.half_width + TOLERANCE
        fitting = [
            number
            for number in self._truth.in_force(begin, end)
            if (source := self._truth.epochs[number].sources.get(series)) is not None
            and self._fits(sample.value, source, begin, end)
        ]
        if not fitting:
            self.wrong.append(f"{sample}: {self._story(sample, series, begin, end)}")
        elif max(fitting) < last.get(series, 0):
            self.wrong.append(f"{sample}: of the configuration before")
        else:
            last[series] = max(last.get(series, 0), min(fitting))

    def _fits(self, value: object, source: Source, begin: int, end: int) -> bool:
        laid, start = source.laid, source.start()
        if laid.is_timeless:
            return value == laid.value(source.device, start, 0)
        return any(
            value == laid.value(source.device, start, answer.round)
            for answer in self._between(source.device, begin, end)
            if answer.covers(laid.function, start, laid.count)
        )

    def _between(self, device: int, begin: int, end: int) -> Iterable[Answer]:
        first = bisect.bisect_left(self._received.get(device, []), begin)
        for answer in self._answers.get(device, [])[first:]:
            if answer.received > end:
                return
            if answer.answered <= end:
                yield answer

    def _story(self, sample: Any, series: int, begin: int, end: int) -> str:
        told = []
        for number in self._truth.in_force(begin, end):
            source = self._truth.epochs[number].sources.get(series)
            if source is None:
                told.append(f"configuration {number}: not read")
                continue
            answers = [
                f"{a.round}: {a.function} {a.start}+{a.count} {a.lie}" for a in self._between(source.device, begin, end)
            ]
            where = f"{source.laid.key} at {source.start()} of device {source.device}"
            told.append(f"configuration {number}: {where}, answers {answers}")
        value = f"{sample.value:016x}" if isinstance(sample.value, int) else repr(sample.value)
        return f"{value} at {sample.time}, half width {sample.half_width}; {told}"


def shuffled(items: Iterable[Any], chance: random.Random) -> list[Any]:
    """These items in another order."""
    new = list(items)
    chance.shuffle(new)
    return new
