"""Converts samples to JSON: one document for each device and commit, or one for each sample.

Pure.

1. If the same samples are sent again, their document and its key are the same.
2. A key ends with a digest of the document, so that a document with other content has another key. A repeated commit
   has other content if the sink gets other points since the configuration was read again, or if a part of its samples
   was refused.
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
    """A JSON document for sinks: the samples of one device in one commit, or one alarm event.

    Attributes:
        device: name of the device.
        key: identifies the document: the same when the same content is sent again, else another one.
        content: the data that become JSON.
    """

    device: str
    key: str
    content: dict[str, Any]

    def encode(self) -> bytes:
        """Return the content of the document as JSON, in UTF-8."""
        return _encoded(self.content)


def documents(samples: Sequence[CommittedSample]) -> Iterator[Document]:
    """Yield one document for each commit, device and revision of some samples, in the order of commits.

    The content of a document has ``device``, ``key`` and ``reads``. ``reads`` is a list with one entry for each time:
    ``time`` (nanoseconds since 1970 UTC), ``half_width`` (nanoseconds, the greatest of its samples), ``values`` by
    point, and if there are any, ``uncertain`` and ``bad`` with the reason in words by point. A sample without a value
    is only in ``bad``; NaN and infinities are texts. In a fleet the content also has ``revision``, that of the
    configuration with which the samples were taken.
    """
    for (commit, device, revision), group in groupby(sorted(samples, key=_place), key=lambda each: _place(each)[:3]):
        reads = [_read(moment, list(each)) for moment, each in groupby(group, key=lambda each: each.time)]
        key = f"{commit}-{device}-{_digest([revision, reads] if revision else reads)}"
        yield Document(device, key, {"device": device, "key": key, **_revision(revision), "reads": reads})


def _revision(revision: int) -> dict[str, int]:
    return {"revision": revision} if revision else {}


def _digest(content: Any) -> str:  # JSON
    return hashlib.blake2b(_encoded(content), digest_size=8).hexdigest()


def _encoded(content: Any) -> bytes:  # JSON
    return json.dumps(content, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode(
        "utf-8", "backslashreplace"
    )


def _place(sample: CommittedSample) -> tuple[int, str, int, int]:
    return sample.commit, sample.device, sample.revision, sample.time


def _read(moment: int, samples: list[CommittedSample]) -> dict[str, Any]:
    read: dict[str, Any] = {"time": moment, "half_width": max(sample.half_width for sample in samples)}
    read["values"] = {sample.point: json_number(sample.value) for sample in samples if sample.value is not None}
    for name, quality in (("uncertain", Quality.UNCERTAIN), ("bad", Quality.BAD)):
        found = {sample.point: reason_text(sample.reason) for sample in samples if sample.quality is quality}
        if found:
            read[name] = found
    return read


def sample_document(sample: CommittedSample) -> dict[str, Any]:
    """Return one sample as JSON data: ``time``, ``half_width``, ``value``, ``quality`` and ``reason`` in words.

    ``time`` is nanoseconds since 1970 UTC, ``half_width`` nanoseconds. NaN and infinities are texts. In a fleet it also
    has ``revision``, that of the configuration. It has no names of device and point.
    """
    return {
        "time": sample.time,
        "half_width": sample.half_width,
        "value": json_number(sample.value),
        "quality": sample.quality.name.lower(),
        "reason": reason_text(sample.reason),
        **_revision(sample.revision),
    }


def sample_key(sample: CommittedSample) -> str:
    """Return a key that identifies a sample: a receiver recognises a sample that is sent again by it."""
    return f"{sample.commit}-{sample.device}/{sample.point}-{_digest(sample_document(sample))}"


def alarm_document(alarm: CommittedAlarm) -> Document:
    """Return an alarm event as a JSON document.

    The content has ``device``, ``point``, ``limit``, ``event`` (its kind, such as ``raised``), ``time`` (nanoseconds
    since 1970 UTC), ``value``, ``text`` (the condition in words), ``by`` (who acknowledged) and ``key``.
    """
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
    """Return a value as JSON can represent it: infinities and NaN become texts, other values stay unchanged."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
