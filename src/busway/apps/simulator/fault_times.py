"""Reports when the faults of a simulation begin and end by their schedules.

Knows faults and the event loop whose clock times them; prints nothing.

1. The schedule of a fault begins when this module first looks at it, and not at the first request: a fault is reported
   at the moments from which it changes requests, or changes none.
2. A fault without a schedule is not reported; neither is a fault that is switched off or removed.
"""

import asyncio
from collections.abc import Callable

from ...faults.applied_faults import AppliedFault
from ...faults.switchboard import FaultSwitchboard


async def report_fault_times(switchboard: FaultSwitchboard, report: Callable[[AppliedFault, bool], object]) -> None:
    """Call ``report`` whenever a scheduled fault begins (with True) or ends (with False), until cancelled.

    A fault that is active already is reported at once. An active fault that is switched off or removed is not reported
    as ended.

    Args:
        switchboard: the faults; faults that are added or switched later are reported, too.
        report: called with the fault, and True or False, in the event loop.
    """
    loop = asyncio.get_running_loop()
    changed = asyncio.Event()

    def look_again() -> None:
        loop.call_soon_threadsafe(changed.set)

    unwatch = switchboard.watch(look_again)
    active: set[AppliedFault] = set()
    try:
        while True:
            changed.clear()
            now = loop.time()
            timed = [one for one in switchboard.faults if one.enabled and one.selection.schedule.is_timed]
            active.intersection_update(timed)
            for one in timed:
                if one.is_on(now) != (one in active):
                    active.symmetric_difference_update((one,))
                    report(one, one in active)
            due = min((when for one in timed if (when := one.next_change(now)) is not None), default=None)
            if due is None:
                await changed.wait()
                continue
            timer = loop.call_at(due, changed.set)
            await changed.wait()
            timer.cancel()
    finally:
        unwatch()


__all__ = ["report_fault_times"]
