"""The schema of collector files: links, poll classes, devices with their profiles, the store and sinks.

Knows what can be written and which names have to be there; profiles are read by `busway.apps.collector.configuration`.

An example is in `docs/reference/collector-file.md`.

Rules:

1. A point is read in its own class, or else in that of its unit, or else in that of the device; a file with one class
   needs no names.
2. A profile is a ready-made device, or the path of a device file with one unit; ``with`` sets its parameters.
3. Which keys a sink has depends on its kind (`sinks`).
4. Which samples of a point the store keeps follows from ``store_report`` of the point, or else of the device, or else
   of the point's class, or else of the collector.
"""

import math
import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Final, Literal

from pydantic import BeforeValidator, Field

from ...options.declaration import Name, Range
from .device import UnitSection
from .key_lines import KeyPath
from .listeners import ListenerSection, Url
from .points import Report, ReportSection
from .section import NO_LIST, NO_TABLE, Section
from .simulation import Parameter
from .sinks import AnySink
from .system import LinkSection, SystemFile, twice

NOTHING: Final = "none: a collector serves nothing."
_HOST: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}")
_MOST_HOSTS: Final = 2
RoleName = Literal["view", "operate", "configure"]


class CollectorSection(Section):
    """``[collector]``: where samples are stored, and options of the collector."""

    store: Annotated[str, Name("a folder"), "the folder of the store, made where it is not there."] = "data"
    durability: Annotated[
        Literal["process", "power"],
        "what a commit survives: `process`, the end of the process; `power`, a power failure too.",
    ] = "process"
    keep_days: Annotated[
        float | None, Range(0, 100_000, above=True), "days after which samples are dropped; None: never."
    ] = None
    keep_bytes: Annotated[
        int | None,
        Range(1_000_000, math.inf),
        "size of the store above which the oldest samples are dropped, also those that a sink has not got; None: half",
        "of the disk that the store is on.",
    ] = None
    store_report: Annotated[
        Report, "which samples the store keeps, as `report` of a point, where point, device and class do not say that."
    ] = ReportSection()
    learn: Annotated[bool, "whether what was learnt of devices is kept, in `learnt.json` in the store."] = True
    clock: Annotated[
        Literal["auto", "synchronised", "trusted"] | None,
        "when the wall clock is known to be right: `synchronised`, while the kernel says that a time service keeps it",
        "right; `trusted`, always; `auto`, as `synchronised` in the first ten minutes of the machine, and ten minutes",
        "after a time service was lost; None: what `BUSWAY_CLOCK` in the environment says, else `auto`.",
    ] = None
    page: Annotated[str, Name("an address such as 127.0.0.1:8503"), "host and port of the page; `off` for none."] = (
        "127.0.0.1:8503"
    )


class PageAccessSection(Section):
    """``[page_access]``: tokens and TLS of the page, and what subjects of client certificates may do."""

    tokens: Annotated[
        str | None,
        Name("the path of a file"),
        "the file of tokens, made with a random one for each role where it is not there; None: `page-tokens` in the",
        "store.",
    ] = None
    certificate: Annotated[str | None, Name("the path of a file"), "file in PEM for HTTPS; None: HTTP."] = None
    key: Annotated[str | None, Name("the path of a file"), "file with its private key; None: the same file."] = None
    password_file: Annotated[str | None, Name("the path of a file"), "file whose first line opens the key."] = None
    authority: Annotated[
        str | None, Name("the path of a file"), "who issues client certificates; None: none are asked for."
    ] = None
    revocation_list: Annotated[str | None, Name("the path of a file"), "which of them are revoked."] = None
    subjects: Annotated[
        dict[str, RoleName], 'role by the subject of a client certificate: `"CN=anna,O=plant" = "operate"`.'
    ] = NO_TABLE


class PollClassSection(Section):
    """``[poll_class]``, one poll class: how often its points are read."""

    period: Annotated[float, Range(0.001, 604_800), "seconds between two reads of its points."]
    store_report: Annotated[
        Report | None, "which samples of its points the store keeps; None: as `[collector]` says."
    ] = None


class CollectedDeviceSection(Section):
    """``[[device]]``: a device to poll: its link and its profile."""

    name: Annotated[
        str,
        Name("a name of at most 200 characters without /", r"[^/\s\x00-\x1f][^/\x00-\x1f]{0,199}"),
        "what the device is called in samples and on the page.",
    ]
    link: Annotated[str, "the name of its link."]
    unit: Annotated[
        int | None, Range(0, 255), "its unit identifier; None: 255 on TCP. A device on a line must have one."
    ] = None
    profile: Annotated[str, Name("a profile"), "a ready-made device, or the path of a device file with one unit."]
    with_: Annotated[dict[str, Parameter], "parameters of the profile: `with = { base = 100 }`."] = Field(
        default_factory=dict, alias="with"
    )
    poll_class: Annotated[str, "the class of points that name none; left out: the only class."] = ""
    store_report: Annotated[
        Report | None, "which samples of its points the store keeps; None: as their classes say."
    ] = None
    firmware: Annotated[
        str,
        "what the device runs. What two devices with one profile and firmware learnt alike, the third begins with.",
    ] = ""
    line_baud: Annotated[
        int | None,
        Range(50, 12_000_000),
        "bits per second of the line, where the device is behind a TCP gateway; None: what reads cost is learnt.",
    ] = None


class CollectedLinkSection(LinkSection):
    """``[[link]]``: a named endpoint with its own options, and which machines of a fleet can reach it."""

    hosts: Annotated[
        list[str],
        "in a fleet, the machine that can reach it, or two, the preferred one first; left out: all of them. A serial "
        "port needs it where collectors run on several machines.",
    ] = NO_LIST
    gateway_wait: Annotated[
        float,
        Range(0, 300, "seconds"),
        "in a fleet, seconds for which a gateway behind this link may hold a request, repetitions included. The "
        "link gets another collector only when none can be held any more. 0: a serial port, or a device itself.",
    ] = 0.0


def _none_here(value: object) -> object:
    if value:
        raise ValueError("a collector serves nothing: [[unit]] belongs into the profile of a device")
    return value


class CollectorFile(SystemFile):
    """The checked contents of a collector file."""

    collector: Annotated[CollectorSection, "where samples are stored, and options of the collector."] = (
        CollectorSection()
    )
    page_access: Annotated[PageAccessSection, "who may see and change what on the page."] = PageAccessSection()
    link: Annotated[Sequence[CollectedLinkSection], "named ways to the devices, with options of their own."] = NO_LIST
    poll_class: Annotated[dict[str, PollClassSection], "how often points are read, by name of the class."] = NO_TABLE
    device: Annotated[list[CollectedDeviceSection], "the devices to poll."] = NO_LIST
    sink: Annotated[list[AnySink], "systems that get the samples."] = NO_LIST
    unit: Annotated[list[UnitSection], BeforeValidator(_none_here), NOTHING] = NO_LIST
    listen: Annotated[list[Url], BeforeValidator(_none_here), NOTHING] = NO_LIST
    listener: Annotated[list[ListenerSection], BeforeValidator(_none_here), NOTHING] = NO_LIST

    def class_of(self, device: CollectedDeviceSection) -> str:
        """Return the poll class for points of a device that name none: the device's own, or the only one of the file.

        Empty if the device names none and the file has none or several.
        """
        return device.poll_class or (next(iter(self.poll_class)) if len(self.poll_class) == 1 else "")

    def _whole_faults(self) -> Iterator[tuple[KeyPath, str]]:
        for key, sections in (("link", self.link), ("device", self.device), ("poll_class", self.poll_class)):
            if not sections:
                yield (key,), "is missing"
        yield from _page_access_faults(self.page_access)
        yield from twice("link", [each.name for each in self.link])
        yield from twice("device", [each.name for each in self.device])
        yield from twice("sink", [each.name for each in self.sink])
        for index, link in enumerate(self.link):
            yield from ((("link", index, "hosts"), sentence) for sentence in _host_faults(link.hosts))
        links = [each.name for each in self.link]
        for index, device in enumerate(self.device):
            if links and device.link not in links:
                yield ("device", index, "link"), f"there is no link {device.link!r}, but {', '.join(links)}"
            if device.poll_class and self.poll_class and device.poll_class not in self.poll_class:
                there = ", ".join(self.poll_class)
                yield ("device", index, "poll_class"), f"there is no class {device.poll_class!r}, but {there}"


def _host_faults(hosts: Sequence[str]) -> Iterator[str]:
    for host in hosts:
        if not _HOST.fullmatch(host):
            yield f"{host!r} cannot be the name of a host: letters, digits, - and _, without the domain"
    if len(hosts) > _MOST_HOSTS or len(set(hosts)) < len(hosts):
        yield "has one host, or two: the preferred one, and the one that takes over"


def _page_access_faults(access: PageAccessSection) -> Iterator[tuple[KeyPath, str]]:
    for key in ("key", "password_file", "authority", "revocation_list"):
        if getattr(access, key) is not None and access.certificate is None:
            yield ("page_access", key), "is for a page with TLS: certificate is missing"
    if access.subjects and access.authority is None:
        yield ("page_access", "subjects"), "are those of certificates: the authority that issues them is missing"
