"""The schema of collector files: links, poll classes, devices with their profiles, the store and sinks.

Knows what can be written and which names have to be there; profiles are read by `busway.apps.collector.configuration`.

::

    [collector]
    store = "data"

    [poll_class]
    fast.period = 1.0
    slow.period = 60.0

    [[link]]
    name = "hall"
    url = "rtu:///dev/ttyUSB0?baud=19200"

    [[device]]
    name = "meter-7"
    link = "hall"
    unit = 7
    profile = "meter"
    poll_class = "fast"

    [[sink]]
    name = "broker"
    url = "mqtts://broker.example:8883"

Rules:

1. A point is read in its own class, or else in that of its unit, or else in that of the device; a file with one class
   needs no names.
2. A profile is a ready-made device, or the path of a device file with one unit; ``with`` sets its parameters.
3. What a sink may say depends on its kind and is judged where it is made.
"""

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, ConfigDict, Field

from .device import UnitSection
from .lines import Path
from .listeners import ListenerSection, Url
from .schema import Section
from .simulation import Parameter
from .system import SystemFile, twice

Name = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^/\s\x00-\x1f][^/\x00-\x1f]*$")]
"""A name of a device: it stands before the slash in ``device/point``."""


class CollectorSection(Section):
    """``[collector]``: where samples are stored, and options of the collector."""

    store: str = Field(default="data", min_length=1)
    durability: Literal["process", "power"] = "process"
    keep_days: float | None = Field(default=None, gt=0, le=100_000)
    keep_bytes: int | None = Field(default=None, ge=1_000_000)
    learn: bool = True
    page: str = Field(default="127.0.0.1:8503", min_length=1, max_length=200)


class PageAccessSection(Section):
    """``[page_access]``: tokens and TLS of the page, and what subjects of client certificates may do."""

    tokens: str | None = Field(default=None, min_length=1)
    certificate: str | None = Field(default=None, min_length=1)
    key: str | None = Field(default=None, min_length=1)
    password_file: str | None = Field(default=None, min_length=1)
    authority: str | None = Field(default=None, min_length=1)
    revocation_list: str | None = Field(default=None, min_length=1)
    subjects: dict[str, Literal["view", "operate", "configure"]] = Field(default_factory=dict)


class PollClassSection(Section):
    """``[poll_class]``, one poll class: how often its points are read."""

    period: float = Field(ge=0.001, le=604_800)


class CollectedDeviceSection(Section):
    """``[[device]]``: a device to poll: over which link, and by which profile."""

    name: Name
    link: str
    unit: int | None = Field(default=None, ge=0, le=255)
    profile: str = Field(min_length=1)
    with_: dict[str, Parameter] = Field(default_factory=dict, alias="with")
    poll_class: str = ""
    firmware: str = ""
    line_baud: int | None = Field(default=None, ge=50, le=12_000_000)


class SinkSection(Section):
    """``[[sink]]``: a system that gets the samples; further keys depend on its kind."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="allow", strict=True, frozen=True)

    name: str = Field(min_length=1)
    url: str = Field(min_length=1)


def _none_here(value: object) -> object:
    if value:
        raise ValueError("a collector serves nothing: [[unit]] belongs into the profile of a device")
    return value


class CollectorFile(SystemFile):
    """The checked contents of a collector file."""

    retired: ClassVar[dict[str, str]] = {}

    collector: CollectorSection = CollectorSection()
    page_access: PageAccessSection = PageAccessSection()
    poll_class: dict[str, PollClassSection] = Field(default_factory=dict)
    device: list[CollectedDeviceSection] = Field(default_factory=list)
    sink: list[SinkSection] = Field(default_factory=list)
    unit: Annotated[list[UnitSection], BeforeValidator(_none_here)] = Field(default_factory=list)
    listen: Annotated[list[Url], BeforeValidator(_none_here)] = Field(default_factory=list)
    listener: Annotated[list[ListenerSection], BeforeValidator(_none_here)] = Field(default_factory=list)

    def class_of(self, device: CollectedDeviceSection) -> str:
        """The poll class of a device's points that name none; empty if the device names none and there are several."""
        return device.poll_class or (next(iter(self.poll_class)) if len(self.poll_class) == 1 else "")

    def _whole_faults(self) -> Iterator[tuple[Path, str]]:
        for key, sections in (("link", self.link), ("device", self.device), ("poll_class", self.poll_class)):
            if not sections:
                yield (key,), "is missing"
        yield from _page_access_faults(self.page_access)
        yield from twice("link", [each.name for each in self.link])
        yield from twice("device", [each.name for each in self.device])
        yield from twice("sink", [each.name for each in self.sink])
        links = [each.name for each in self.link]
        for index, device in enumerate(self.device):
            if links and device.link not in links:
                yield ("device", index, "link"), f"there is no link {device.link!r}, but {', '.join(links)}"
            if device.poll_class and self.poll_class and device.poll_class not in self.poll_class:
                there = ", ".join(self.poll_class)
                yield ("device", index, "poll_class"), f"there is no class {device.poll_class!r}, but {there}"


def _page_access_faults(access: PageAccessSection) -> Iterator[tuple[Path, str]]:
    for key in ("key", "password_file", "authority", "revocation_list"):
        if getattr(access, key) is not None and access.certificate is None:
            yield ("page_access", key), "is for a page with TLS: certificate is missing"
    if access.subjects and access.authority is None:
        yield ("page_access", "subjects"), "are those of certificates: the authority that issues them is missing"


def sink_options(section: SinkSection) -> dict[str, Any]:  # Any: what TOML has
    """The keys of a sink beside its name and URL."""
    return dict(section.model_extra or {})
