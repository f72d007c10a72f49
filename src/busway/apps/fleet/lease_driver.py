"""The asyncio driver of a `LeaseHolder`: makes its proposed changes at the coordinator, and passes the answers back.

Knows tasks and the clock; which changes are proposed, and what follows from an answer, is decided by `lease_holder`.

1. A transaction is permitted by `LeaseHolder.permits`, asked with `boot_time` right before bytes are sent. No task
   has to run first: a process that was frozen finds its leases lapsed, whatever runs first when it goes on.
2. After an error of the coordinator the outcome of a change counts as unknown, and the driver goes on.
3. If following a shared table ends by an unexpected error, such as a defect of a client library, the error is logged,
   and the table is followed again. All parts of a fleet that follow a table do so by `keep_following`.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from contextlib import aclosing
from typing import Final

from ...errors import ConfigError
from ..collector.cancellation import end_if_cancelled
from ..collector.task_errors import first_error, log_defect
from ..collector.time_service import seconds_since_boot
from .coordinator import (
    SNAPSHOT_BEGINS,
    SNAPSHOT_ENDS,
    Coordinator,
    CoordinatorDown,
    OutcomeUnknown,
    RevisionConflict,
)
from .lease_holder import LeaseHolder, NotConfirmed, Proposal, ShardEvent

WATCH_AGAIN: Final = 0.5
"""Seconds before the table is followed again after an unexpected error."""
_log = logging.getLogger("busway.fleet")


def boot_time() -> float:
    """Return the time of the clock of leases, in seconds since an arbitrary moment.

    The clock is never set, and on Linux it also counts while the machine sleeps.
    """
    return seconds_since_boot()


async def keep_following(follow: Callable[[], Awaitable[None]], table: str, begin_anew: Callable[[], None]) -> None:
    """Follow a shared table until cancelled: after an unexpected error, which is logged, follow it again (rule 3).

    Args:
        follow: reads the table from its start and follows it; ends only by an error.
        table: the table, in words, for the log.
        begin_anew: called after each error: entries known so far may be out of date until they are shown again.

    Raises:
        ConfigError: the table can never be read.
    """
    while True:
        try:
            await follow()
        except ConfigError:
            raise
        except Exception:  # a defect of a client library: else what is known would be stale for good
            _log.exception("%s cannot be followed; it is read anew", table)
        except asyncio.CancelledError:
            end_if_cancelled()
            _log.error("following %s was cancelled, though not by this program; it is read anew", table)
        begin_anew()
        await asyncio.sleep(WATCH_AGAIN)


class LeaseDriver:
    """Runs a `LeaseHolder` on asyncio: gives it the entries of the shared table, and makes the changes it proposes.

    Args:
        member: holds the leases of one collector, and decides which changes to make.
        coordinator: the coordinator of its zone; not closed here.
        told: called with each event of a shard (group of links), in order, in the event loop; it must be quick.
        now: returns the time of the clock of leases, in seconds.
        behind: returns the number of commits that not all sinks have.

    Attributes:
        member: the `LeaseHolder` that is run.
    """

    def __init__(
        self,
        member: LeaseHolder,
        coordinator: Coordinator,
        told: Callable[[ShardEvent], None],
        *,
        now: Callable[[], float] = boot_time,
        behind: Callable[[], int] = lambda: 0,
    ) -> None:
        self.member: LeaseHolder = member
        self._behind = behind
        self._coordinator, self._told, self._now = coordinator, told, now
        self._wake = asyncio.Event()
        self._changed = asyncio.Event()
        self._error: str | None = None
        self._logged: set[str] = set()
        self._problem = ""
        self._asking: set[asyncio.Task[None]] = set()

    @property
    def error(self) -> str | None:
        """Why the coordinator has not confirmed the last change of the shared table, in words; None if it has.

        None at first too. A change that was refused because the entry had another revision leaves this as it was.
        """
        return self._error

    @property
    def problem(self) -> str:
        """Why this collector may own no shard, or why its changes are not confirmed, in words; empty while all is well.

        Shards whose leases cannot be renewed are lost soon.
        """
        return self.member.problem or self._error or ""

    async def run(self) -> None:
        """Follow the shared table, and take, renew and release shards (groups of links), until cancelled.

        Raises:
            ConfigError: the table can never be read, for example because rights are missing.
        """
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(
                    keep_following(self._follow_table, "the table of the zone", self.member.begin_snapshot)
                )
                tasks.create_task(self._take_turns())
        except ExceptionGroup as group:
            raise first_error(group) from None
        finally:
            for task in self._asking:
                task.cancel()
            await asyncio.gather(*self._asking, return_exceptions=True)

    def wake(self) -> None:
        """Have `run` ask the `LeaseHolder` for changes at once; to be called after that object's state was changed."""
        self._wake.set()

    async def end(self, seconds: float) -> bool:
        """Release all shards (groups of links) and leave the zone, while `run` still runs.

        Returns True once that is done, and False if it is not done in time; it then goes on while `run` runs.

        Args:
            seconds: longest wait.
        """
        self.member.end()
        self.wake()
        try:
            async with asyncio.timeout(seconds):
                while not self.member.has_ended:
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            return False
        return True

    async def _follow_table(self) -> None:
        async with aclosing(self._coordinator.watch()) as entries:
            async for entry in entries:
                if entry is SNAPSHOT_BEGINS:
                    self.member.begin_snapshot()
                elif entry is SNAPSHOT_ENDS:
                    self.member.end_snapshot(self._now())
                else:
                    self._set_wall_clock()
                    self.member.entry(entry, self._now())
                self.wake()

    async def _take_turns(self) -> None:
        while True:
            self._wake.clear()
            self._set_wall_clock()
            self.member.behind = self._behind()
            for proposal in self.member.turn(self._now()):
                task = asyncio.create_task(self._ask(proposal), name=f"busway fleet change of {proposal.key}")
                self._asking.add(task)
                task.add_done_callback(log_defect)
                task.add_done_callback(self._asking.discard)
            for event in self.member.events():
                self._told(event)
            self._log_problem()
            self._changed.set()
            wait = self.member.next_turn() - self._now()
            try:
                async with asyncio.timeout(min(max(wait, 0.0), 60.0)):
                    await self._wake.wait()
            except TimeoutError:
                pass

    def _set_wall_clock(self) -> None:
        self.member.wall_ahead = time.time() - self._now()

    def _log_problem(self) -> None:
        """Log once that this collector may own no links, with the first reason, and once when it may again."""
        problem = self.member.problem
        if problem != self._problem:
            if not problem:
                _log.warning("collector %s may own links again", self.member.name)
            elif not self._problem:
                _log.error("collector %s owns nothing: %s", self.member.name, problem)
            self._problem = problem

    def _failed(self, error: str) -> None:
        """Set `error` to the reason why a change of the shared table was not confirmed.

        Log the reason unless it was logged since the last confirmed change.
        """
        self._error = error
        if error not in self._logged:
            self._logged.add(error)
            _log.warning("the coordinator does not confirm: %s", error)

    async def _ask(self, proposal: Proposal) -> None:
        result: int | NotConfirmed = NotConfirmed.UNKNOWN
        try:
            async with asyncio.timeout(self.member.times.answer):
                if proposal.revision:
                    result = await self._coordinator.replace(proposal.key, proposal.value, proposal.revision)
                else:
                    result = await self._coordinator.create(proposal.key, proposal.value)
            self._error = None
            self._logged.clear()
        except RevisionConflict:
            result = NotConfirmed.CONFLICT
        except (CoordinatorDown, OutcomeUnknown, TimeoutError) as error:
            self._failed(str(error) or "no answer in time")
        except Exception as error:  # a defect of a client library: else its key would stay open for good
            _log.exception("the coordinator fails in an unexpected way")
            self._error = f"{type(error).__name__}: {error}"
        except asyncio.CancelledError:
            end_if_cancelled()
            self._failed("the request was cancelled, though not by this collector")
        self.member.outcome(proposal, result, self._now())
        self.wake()
