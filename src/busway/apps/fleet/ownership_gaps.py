"""Gaps of ownership: times in which a link had no owner, because its former owner fell silent.

Pure: knows no file, stream or sink.

1. The new owner records a gap: from the former owner's last renewal of the lease to the begin of the new ownership. The
   former owner may have polled for a while after that renewal, so the real gap can be shorter.
2. Nothing of a device is missing before its newest sample in the gap, so the time of that sample is the true begin.
   The sample may be of either owner, and may arrive late: then a later sample moves the begin to its own time, and an
   earlier one changes nothing. The order in which samples arrive does not matter.
3. The marks without a value that an owner writes for a time without reads (`Reason.OWNERSHIP`) do not count as samples
   here.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from .epoch import Epoch


@dataclass(frozen=True, slots=True)
class OwnershipGap:
    """A time in which a link had no owner, as its next owner has recorded it.

    Attributes:
        link: name of the link.
        epoch: epoch of the ownership that ended the gap.
        commit: the first commit number that the new owner can use for samples of ``epoch``: one more than its last
            commit before this ownership.
        devices: names of the devices of the link.
        begin: when the former owner renewed its lease for the last time, in nanoseconds since 1970 UTC.
        end: when the new ownership began, in nanoseconds since 1970 UTC; samples of the new owner are later.
    """

    link: str
    epoch: Epoch
    commit: int
    devices: tuple[str, ...]
    begin: int
    end: int


def true_begin(begin: int, end: int, times: Iterable[int]) -> int:
    """Return when a gap of a device really began, in nanoseconds since 1970 UTC (rule 2).

    That is the time of the device's newest sample within the gap; ``begin`` if there is no sample in the gap.

    Args:
        begin: begin of the gap as it was recorded, nanoseconds since 1970 UTC.
        end: end of the gap, nanoseconds since 1970 UTC; a sample at this very time is outside of the gap.
        times: times of samples of the device, nanoseconds since 1970 UTC, in any order; those outside of the gap are
            ignored.
    """
    return max((time for time in times if begin <= time < end), default=begin)
