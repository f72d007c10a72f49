"""Admission test before the start: computes whether each link can keep the poll periods of its devices.

Pure: knows plans and periods; knows no clock and no socket.

1. The load of a link is the seconds that its reads take in each second. Above `MOST_LOAD` rounds will be late, because
   silent devices, repetitions and writes need the rest.
2. A poll class can miss rounds even on a quiet link if its period is not longer than its own reads, the longest read of
   another device and one timeout together. A device that is alone on its link waits for no other.
3. Each class is counted by itself, as if no reads were shared. So the real load is the computed one or less.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from .plan_cache import PlanBook

MOST_LOAD: Final = 0.85
"""Largest load of a link that is accepted, in seconds of reads in each second."""


@dataclass(frozen=True, slots=True)
class LinkLoad:
    """The result of the admission test of a link: its computed load, and the poll periods that it cannot keep.

    Attributes:
        link: name of the link.
        load: seconds of reads in each second, all poll classes together; above 1 is possible.
        by_class: seconds of reads in each second, by poll class.
        problems: the poll periods that cannot be kept, each as a sentence that says what to change; empty if none.
    """

    link: str
    load: float
    by_class: Mapping[str, float] = field(default_factory=dict)
    problems: tuple[str, ...] = ()

    @property
    def fits(self) -> bool:
        """Whether the link can keep the poll periods of all its devices: True if there are no ``problems``."""
        return not self.problems


def load_of_link(link: str, devices: Iterable[tuple[str, PlanBook, Mapping[str, float]]], timeout: float) -> LinkLoad:
    """Compute the load of a link, and whether it can keep the poll periods of its devices.

    Args:
        link: name of the link.
        devices: for each device its name, its read plans and its poll periods (seconds by poll class).
        timeout: seconds that a read without a reply takes.
    """
    load: dict[str, float] = {}
    own: dict[str, tuple[float, str]] = {}  # by class, the longest round and whose it is
    longest: list[tuple[float, str]] = []  # the longest read of each device
    periods: dict[str, float] = {}
    for device, book, classes in devices:
        widest = 0.0
        for name, period in classes.items():
            if name not in book.classes:
                continue
            plan = book.plan_for(frozenset({name}))
            load[name] = load.get(name, 0.0) + plan.seconds / period
            own[name] = max(own.get(name, (0.0, "")), (plan.seconds, device))
            periods[name] = period
            widest = max([widest, *(read.seconds for read in plan.reads)])
        longest.append((widest, device))
    problems = [*_overload(link, load, periods), *_too_fast(own, periods, longest, timeout)]
    return LinkLoad(link, sum(load.values()), load, tuple(problems))


def _overload(link: str, load: Mapping[str, float], periods: Mapping[str, float]) -> Iterable[str]:
    total = sum(load.values())
    if total <= MOST_LOAD:
        return
    worst = max(load, key=lambda name: load[name])
    said = f"link {link} would need {total:.2f} s of every second, and {MOST_LOAD} is the most"
    room = MOST_LOAD - (total - load[worst])
    if room > 0.05 * load[worst]:
        yield f"{said}: give class {worst} a period of {_rounded(periods[worst] * load[worst] / room)} s or more"
    else:
        both = _rounded(total / MOST_LOAD)
        yield f"{said}: give class {worst}, and then the others, a period {both} times as long, or split the link"


def _too_fast(
    own: Mapping[str, tuple[float, str]],
    periods: Mapping[str, float],
    longest: Iterable[tuple[float, str]],
    timeout: float,
) -> Iterable[str]:
    reads = sorted(longest, reverse=True)[:2]
    for name, (seconds, device) in own.items():
        other = next((each for each, whose in reads if whose != device), None)
        if other is None:
            if periods[name] <= seconds:
                yield f"class {name} has a period of {periods[name]:g} s, and {device} needs {seconds:.3f} s for it"
            continue
        needed = seconds + other + timeout
        if periods[name] <= needed:
            yield (
                f"class {name} has a period of {periods[name]:g} s; {device} needs {seconds:.3f} s for it, another"
                f" device may hold the link for {other:.3f} s, and a silent one for {timeout:g} s: give it"
                f" {_rounded(needed)} s or more, or the link a shorter timeout"
            )


def _rounded(value: float) -> str:
    """Return a number about 5 % higher, as text with two significant digits; used to recommend a period."""
    text = f"{value * 1.05:.2g}"
    return text if "e" not in text else f"{float(text):.0f}"
