"""Converts samples to JSON: one document for each device and commit, or one for each sample.

Pure.

1. A repetition gives the same document with the same key, because a commit does not change.
2. A key ends with a digest of what it stands for, so that a document with other content has another key: where a file
   that was read again hands on other points, or where a part of a batch was refused.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from ..samples import Quality, reason_text
from ..store.committed_samples import CommittedAlarm, CommittedSample


@dataclass(frozen=True, slots=True)
class Document:
    """The samples of one device in one commit as one JSON document, for sinks.

    Attributes:
        device: its name.
        key: the same at a repetition, and different for every other document.
        content: the data that become JSON.
    """

    device: str
    key: str
    content: dict[str, Any]

    def encode(self) -> bytes:
        """Return the document with samples as JSON bytes."""
        return _encoded(self.content)


def documents(samples: Sequence[CommittedSample]) -> Iterator[Document]:
    """Return one document for each commit and device, in the order of commits.

    ``reads`` has one entry for each time: ``time`` (nanoseconds since 1970 UTC), ``values`` by point, and where there
    are any, ``uncertain`` and ``bad`` with the reason by point.
    """
    for (commit, device), group in groupby(sorted(samples, key=_place), key=lambda each: (each.commit, each.device)):
        reads = [_read(moment, list(each)) for moment, each in groupby(group, key=lambda each: each.time)]
        key = f"{commit}-{device}-{_digest(reads)}"
        yield Document(device, key, {"device": device, "key": key, "reads": reads})


def _digest(content: Any) -> str:  # JSON
    return hashlib.blake2b(_encoded(content), digest_size=8).hexdigest()


def _encoded(content: Any) -> bytes:  # JSON
    return json.dumps(content, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode(
        "utf-8", "backslashreplace"
    )


def _place(sample: CommittedSample) -> tuple[int, str, int]:
    return sample.commit, sample.device, sample.time


def _read(moment: int, samples: list[CommittedSample]) -> dict[str, Any]:
    read: dict[str, Any] = {"time": moment, "half_width": max(sample.half_width for sample in samples)}
    read["values"] = {sample.point: json_number(sample.value) for sample in samples if sample.value is not None}
    for name, quality in (("uncertain", Quality.UNCERTAIN), ("bad", Quality.BAD)):
        found = {sample.point: reason_text(sample.reason) for sample in samples if sample.quality is quality}
        if found:
            read[name] = found
    return read


def sample_document(sample: CommittedSample) -> dict[str, Any]:
    """Return one sample as JSON data."""
    return {
        "time": sample.time,
        "half_width": sample.half_width,
        "value": json_number(sample.value),
        "quality": sample.quality.name.lower(),
        "reason": reason_text(sample.reason),
    }


def sample_key(sample: CommittedSample) -> str:
    """Return a key that is unique to a sample, by which a receiver recognises one sent twice."""
    return f"{sample.commit}-{sample.device}/{sample.point}-{_digest(sample_document(sample))}"


def alarm_document(alarm: CommittedAlarm) -> Document:
    """Return an alarm event as JSON data: ``event`` is raised, acknowledged, cleared or removed."""
    event = alarm.event
    content: dict[str, Any] = {
        "device": event.device,
        "point": event.point,
        "limit": event.limit,
        "event": event.kind.value,
        "time": event.at,
        "value": json_number(event.value),
        "text": event.text,
        "by": event.by,
    }
    content["key"] = key = f"alarm-{alarm.commit}-{alarm.place}-{_digest(content)}"
    return Document(event.device, key, content)


def json_number(value: Any) -> Any:  # whatever a sample can be
    """Return a value as JSON can represent it; infinities and NaN become texts."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
