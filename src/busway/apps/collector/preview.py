"""What a collector would do, without traffic: its reads, the load of each link, undeclared registers, what was
learnt.

Knows plans; sends nothing.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from ...values import Address, format_address
from .admission import LinkLoad
from .configuration import CollectedDevice, CollectorConfiguration
from .knowledge import Knowledge
from .plan import PlannedRead, undeclared


@dataclass(frozen=True, slots=True)
class PreviewedRead:
    """One read request that a device would get from the collector.

    Attributes:
        device, poll_class: the device and the poll class that it reads.
        first: the address of its first item.
        count: registers or bits.
        points: number of points it reads, also of other classes.
        seconds: how long it takes.
        undeclared: addresses it reads that belong to no point and no readable range: ``4x5…4x9``.
    """

    device: str
    poll_class: str
    first: str
    count: int
    points: int
    seconds: float
    undeclared: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class CollectorPreview:
    """What a collector would do if it were started: reads, loads, undeclared registers.

    Attributes:
        reads: the reads of all devices and poll classes.
        unreadable: points that no read may bring, each with the reason.
        loads: the admission test of each link.
        learnt: by device, what is known from before; and what its first reads would teach.
    """

    reads: tuple[PreviewedRead, ...]
    unreadable: tuple[tuple[str, str, str], ...]
    loads: tuple[LinkLoad, ...]
    learnt: tuple[tuple[str, str], ...]


def preview(configuration: CollectorConfiguration, knowledge: Knowledge) -> CollectorPreview:
    """Compute what a collector would do (reads, loads), given what was learnt about its devices. Sends nothing."""
    reads: list[PreviewedRead] = []
    unreadable: list[tuple[str, str, str]] = []
    learnt: list[tuple[str, str]] = []
    for device in configuration.devices.values():
        known = configuration.known_of(device, knowledge)
        book = device.book(known)
        for name in device.items:
            plan = book.plan_for(frozenset({name}))
            reads += [_previewed(device, name, read) for read in plan.reads]
            unreadable += [(device.name, each.item.name, each.reason) for each in plan.unreadable]
        learnt += [(device.name, line) for line in (*known.lines(), *_open_questions(device, known.base))]
    return CollectorPreview(tuple(reads), tuple(unreadable), tuple(configuration.loads(knowledge)), tuple(learnt))


def _previewed(device: CollectedDevice, name: str, read: PlannedRead) -> PreviewedRead:
    holes = undeclared(read, device.points, device.rules)
    return PreviewedRead(
        device.name,
        name,
        format_address(Address(read.table, read.start)),
        read.width,
        len(read.items),
        read.seconds,
        tuple(_range(read, hole.start, hole.end) for hole in holes),
    )


def _range(read: PlannedRead, start: int, end: int) -> str:
    first = format_address(Address(read.table, start))
    return first if end - start == 1 else f"{first}…{format_address(Address(read.table, end - 1))}"


def _open_questions(device: CollectedDevice, base: float | None) -> Iterator[str]:
    if base is None:
        what = "what a read costs" if device.fixed else "what a read and a register cost"
        yield f"would learn {what}, by reads of three widths (assumed: {1000 * device.cost.base:.1f} ms a read)"
