"""Computes, without traffic, what a collector would do: its reads, link loads, undeclared registers, what was learnt.

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
    """One read request that the collector would send to a device in each round of a poll class.

    Attributes:
        device: name of the device.
        poll_class: name of the poll class.
        first: address of the first register or bit that the request reads.
        count: registers or bits that the request reads.
        points: number of points that the request reads, including points of other poll classes.
        seconds: how long the request and its reply are expected to take.
        undeclared: the addresses in the read that belong to no point, readable range or exact block, such as
            ``4x5…4x9``.
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
    """What a collector would do if it were started: its reads, the load of each link, and what it knows of devices.

    Attributes:
        reads: the reads of all devices and poll classes.
        unreadable: points that no allowed read can fetch; each is device name, point name and reason.
        loads: the result of the admission test for each link.
        learnt: pairs of a device name and a sentence: a fact that earlier runs learnt, or what a run would find out.
    """

    reads: tuple[PreviewedRead, ...]
    unreadable: tuple[tuple[str, str, str], ...]
    loads: tuple[LinkLoad, ...]
    learnt: tuple[tuple[str, str], ...]


def preview(configuration: CollectorConfiguration, knowledge: Knowledge) -> CollectorPreview:
    """Compute the reads and link loads that a collector would have if it were started. Sends nothing.

    Args:
        configuration: the collector's configuration.
        knowledge: what earlier runs learnt about the devices; the read plans depend on it.
    """
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
