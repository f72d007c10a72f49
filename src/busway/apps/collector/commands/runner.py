"""Executes commands that write points of a running collector: checks, records, sends, reads back, reports.

Knows the journal, the audit log and the pollers of links; decides by `point_write`. Runs in one event loop.

1. A command with a key is sent at most once, ever. The first command with a key takes it; the key is recorded before
   anything is sent (`journal`), in a fleet for all collectors (`claims`). If the same command comes again, it gets the
   result of the first; another command with the same key is refused.
2. A command that is against a rule is refused, and one that is too late expires, before any byte is sent; that is
   recorded. If too many commands are open, the link is not polled at this moment, or audit log or journal cannot be
   written, it is refused without a record, so that it can be given again. Its key is looked up before: a command that
   was sent never appears refused. The same holds for all commands that come while the collector ends.
   Rights and value are checked when a command is taken and again in its turn: the configuration may have changed. What
   is against a rule only then has failed.
3. One command of a device runs at a time, in the order in which they came. It is sent in a turn of the poller, before
   reads, and never repeated, whatever the options of the link are. Its time is over as soon as the wall clock or the
   monotonic clock says so: setting the clock can shorten the time, never lengthen it.
4. The result of a command is in the audit log before it is in the journal, and in the journal before the caller gets
   it. A result that the journal cannot take waits in memory (`CommandRunner.record_again`). A command goes on when its
   caller has stopped waiting. It ends with its link at the latest.
5. `CommandState.DONE` means: the device has answered, and shows the value if the point's rule asks to read it back. A
   device may need some time to show a value, so it is read up to three times, after the pauses `SHOWN_AFTER`.
"""

import asyncio
import logging
import math
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol, TypeVar

from ....access.audit_log import AuditLog
from ....errors import InvalidRequest, ModbusError, Overloaded
from ....options.sinks import LONGEST_SECONDS
from ....pdu.message import Request
from ....points.point import Point
from ....points.point_rules import ReadRules
from ....points.quality import Quality
from ....values.unfit_values import shown
from ..poller import LinkPoller
from .audit import command_line
from .claims import KeyClaims, KeysUnavailable
from .command import (
    MADE,
    USUAL_SECONDS,
    CommandResult,
    CommandState,
    CommandValue,
    OldValue,
    PointCommand,
    is_key,
    new_key,
)
from .journal import CommandJournal
from .point_read import PointRead
from .point_write import PointWrite, judged, plain, point_write
from .rights import WriterRights

PROGRAM: Final = WriterRights()
"""The rights of a program that runs the collector in its own process: role ``configure``, nothing armed."""
MOST_OPEN: Final = 16
"""Most commands of one device that may wait or run; further ones are refused."""
MOST_OPEN_IN_ALL: Final = 1000
"""Most commands of all devices together that may wait or run; further ones are refused."""
MOST_ARMED: Final = 256
ARMED_SECONDS: Final = 60.0
"""Seconds within which an armed command must be confirmed."""
_NOT_ARMED: Final = "there is no command with this key; arm it anew"
SHOWN_AFTER: Final = (0.0, 0.5, 2.0)
"""Seconds to wait before the first, second and third read that looks whether the device shows the written value."""

_log = logging.getLogger("busway.collector.commands")
_T = TypeVar("_T")


class NoSuchPoint(InvalidRequest):
    """Error: the collector has no such device, or the device no such point."""


class NotPolledNow(InvalidRequest):
    """Error: this collector does not poll the device's link at this moment; nothing was sent. Try again.

    The link is being stopped for a new configuration, or another collector of the fleet polls it.
    """


class NoSuchCommand(InvalidRequest):
    """Error: no command with this key is armed or recorded."""


@dataclass(frozen=True, slots=True)
class WriteTarget:
    """A point that a command can write, and the poller of its link.

    Attributes:
        point: the point.
        poller: polls its device.
        rules: the limits for reading its device.
        is_broadcast: whether a write to the device is a broadcast, which all devices of a line execute.
        is_absent: whether the point belongs to a group of points that the device, by its own values, does not have.
    """

    point: Point
    poller: LinkPoller
    rules: ReadRules = field(default_factory=ReadRules)
    is_broadcast: bool = False
    is_absent: bool = False


class CommandTargets(Protocol):
    """Interface through which commands find points of a collector."""

    def target(self, device: str, point: str) -> WriteTarget:
        """Return a point and the poller of its link.

        Raises:
            NoSuchPoint: there is no such device or point.
            NotPolledNow: the link is not polled at this moment.
        """

    def last(self, device: str, point: str) -> OldValue | None:
        """Return the last known value of a point; None if there is none."""


@dataclass(frozen=True, slots=True)
class ArmedCommand:
    """A command that was checked and waits for confirmation by a person. Nothing was sent to the device.

    Attributes:
        command: the command.
        old: the point's last known value; None if none is known.
        sentence: the question for the person who confirms.
        until: until when it may be confirmed, seconds of the monotonic clock.
        poller: the poller of the device when the command was armed. If the device has another poller later, its link
            was begun anew, and the names of device and point may mean something else.
    """

    command: PointCommand
    old: OldValue | None
    sentence: str
    until: float
    poller: LinkPoller


@dataclass(frozen=True, slots=True)
class _Permission:
    """The rights and limits of one command, checked when it is taken and again in its turn.

    Attributes:
        rights: what its writer may do.
        poller: the poller that the device had when the command was armed; with another one the command is refused. None
            for any poller.
        until: until when the command may be sent, seconds of the event loop's clock; its expiry holds too.
    """

    rights: WriterRights
    poller: LinkPoller | None = None
    until: float = math.inf


class _LinkEnded(Exception):
    """Error: polling of the link has ended before a command was sent, or while its answer was awaited."""


@dataclass(slots=True)
class _Running:
    """A command in execution.

    Attributes:
        command: the command.
        task: executes it, and returns its result.
        has_taken: whether the journal has recorded the key for this command. Until then the journal may show that an
            earlier command used it, so another command with this key waits and is not refused.
    """

    command: PointCommand
    task: "asyncio.Task[CommandResult]"
    has_taken: bool = False


def _ignore_step(name: str) -> None:
    """Do nothing. This is the default of ``step``, which is called after each step of a command; tests give another."""


class CommandRunner:
    """Executes commands that write points of a running collector.

    Args:
        targets: finds points and their pollers.
        journal: where commands are recorded. Commands that an earlier process left open in it end as unknown now.
            `close` closes it.
        audit: gets a line for each command; repeated refusals are counted in one line (`refused`).
        claims: takes keys for all collectors of a fleet; None for a collector that works alone.
        now: returns seconds since 1970 UTC.
        moment: returns seconds of the monotonic clock, for commands that wait to be confirmed.
        step: called with the name of each step that a command has reached: ``claimed``, ``answered``, ``recorded``.

    Raises:
        OSError: the journal cannot be read or written.
    """

    def __init__(
        self,
        targets: CommandTargets,
        journal: CommandJournal,
        audit: AuditLog,
        *,
        claims: KeyClaims | None = None,
        now: Callable[[], float] = time.time,
        moment: Callable[[], float] = time.monotonic,
        step: Callable[[str], None] = _ignore_step,
    ) -> None:
        self._targets, self._journal, self._audit, self._claims = targets, journal, audit, claims
        self._now, self._moment, self._step = now, moment, step
        self._running: dict[str, _Running] = {}
        self._armed: dict[str, ArmedCommand] = {}
        self._devices: dict[str, tuple[asyncio.Lock, int]] = {}
        self._unrecorded: dict[str, CommandResult] = {}
        self._subscribers: list[Callable[[CommandResult], None]] = []
        self._closed = self._has_ended = False
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="busway-commands")
        for each in journal.end_cut_off():
            self._append(each)

    def subscribe(self, told: Callable[[CommandResult], None]) -> None:
        """Register a function that is called with the result of each recorded command when the command has ended.

        It is called in the event loop, and must be quick. What it raises is logged, and changes no result.
        """
        self._subscribers.append(told)

    async def close(self) -> None:
        """Refuse new commands, wait for those in progress and their records, and close the journal.

        The links must have stopped before.
        """
        self._closed = True
        self._armed.clear()
        await asyncio.gather(*(each.task for each in self._running.values()), return_exceptions=True)
        await self.record_again()
        self._has_ended = True
        self._thread.shutdown()
        self._journal.close()

    async def record_again(self) -> None:
        """Record results of commands that could not be recorded when they ended. Call it from time to time.

        A result that fails again waits for the next call, without an error. Raises `OSError` after `close` if results
        are left.
        """
        if self._unrecorded:
            await self._in_thread(self._record_unrecorded)

    # What callers use.

    async def write(
        self,
        device: str,
        point: str,
        value: CommandValue,
        *,
        by: str,
        origin: str,
        expires: float | None = None,
        key: str | None = None,
        rights: WriterRights = PROGRAM,
    ) -> CommandResult:
        """Write a value to a point by a command, and return the command's result.

        If the key was used before for the same value and point, nothing is sent again, and the result of that command
        is returned. If it was used for another value or point, the result is a refusal. The command goes on if the
        caller is cancelled.

        Args:
            device, point: the point to write.
            value: a number in the unit of measure, a state, a text, the name of a number, or a list of names of flags.
            by, origin: who gives the command, and the way on which it came (`PointCommand`).
            expires: until when it may be sent, seconds since 1970 UTC; None for `USUAL_SECONDS` from now.
            key: names the command for ever; must not begin with `MADE`. None for a new key.
            rights: what the writer may do.

        Returns:
            The result; also for a command that was refused, failed or expired: its state says so. Also if the journal
            cannot be read or written.

        Raises:
            InvalidRequest: an argument is out of its limits, or there is no such point and the key is new. Nothing was
                sent or recorded.
        """
        now = self._now()
        if key is not None and isinstance(key, str) and key.startswith(MADE):
            raise InvalidRequest(f"keys that begin with {MADE} are made here; choose another")
        command = PointCommand(
            key if key is not None else new_key(now),
            device,
            point,
            value,
            by,
            origin,
            now + USUAL_SECONDS if expires is None else expires,
        )
        try:
            self._targets.target(device, point)
        except NotPolledNow as error:
            return await self._refused_now(command, error.message)
        except NoSuchPoint as error:  # now; a command with this key may have been sent before
            try:
                known = await self._known(command)
            except OSError as problem:
                return self._refused_unread(command, error.message, problem)
            if known is None:
                raise
            return known
        return await self._submit(command, rights)

    def arm(
        self,
        device: str,
        point: str,
        value: CommandValue,
        *,
        by: str,
        origin: str,
        rights: WriterRights = PROGRAM,
    ) -> ArmedCommand:
        """Check a command and keep it, so that `confirm` can send it within `ARMED_SECONDS`; send nothing now.

        A command that is against a rule gets a line in the audit log.

        Args:
            device, point: the point to write.
            value: as for `write`.
            by, origin: who gives the command, and the way on which it came (`PointCommand`).
            rights: what the writer may do.

        Returns:
            The armed command, with its new key and the question for the person who confirms.

        Raises:
            NoSuchPoint: there is no such point.
            NotPolledNow: the link is not polled by this collector at this moment.
            InvalidRequest: an argument is out of its limits, or the command is against a rule; the message says which.
            Overloaded: too many commands wait to be confirmed.
        """
        now, moment = self._now(), self._moment()
        command = PointCommand(new_key(now), device, point, value, by, origin, now + ARMED_SECONDS)
        target = self._targets.target(device, point)
        refusal = self._refusal(command, _Permission(replace(rights, has_armed=True)))
        if refusal:
            self.refused(self._result(command), refusal)
            raise InvalidRequest(refusal)
        for key in [key for key, each in self._armed.items() if each.until + ARMED_SECONDS < moment]:
            del self._armed[key]
        if len(self._armed) >= MOST_ARMED:
            raise Overloaded(f"{MOST_ARMED} commands wait to be confirmed; try again in a minute")
        old = self._targets.last(device, point)
        is_now = f", now {_text(old.value, target.point)} ({old.quality})" if old is not None else ""
        sentence = f"Write {_text(value, target.point)} to {device}/{point}{is_now}?"
        armed = ArmedCommand(command, old, sentence, moment + ARMED_SECONDS, target.poller)
        self._armed[command.key] = armed
        return armed

    async def confirm(
        self,
        key: str,
        *,
        by: str,
        origin: str | None = None,
        point: tuple[str, str] | None = None,
        seconds: float = math.inf,
        rights: WriterRights = PROGRAM,
    ) -> CommandResult:
        """Send an armed command and return its result. For a command that runs or is recorded, only return its result.

        The result is expired if `ARMED_SECONDS` have passed since the command was armed; much later it is no longer
        known that it was armed. A command whose link is not polled now, or was begun anew, is no longer armed after
        this call. For a command that runs or is recorded, ``by`` and ``origin`` are not compared.

        Args:
            key: the key of the armed command.
            by: who confirms; must be the one who armed the command.
            origin: the way on which the confirmation came; must be that of the command. None for any.
            point: device and point that the command must be for; None for any.
            seconds: seconds from now within which the command may be sent; `ARMED_SECONDS` limit it too.
            rights: what the writer may do now, possibly less than when the command was armed.

        Raises:
            NoSuchCommand: nothing is armed or recorded under this key.
            InvalidRequest: the command was armed by another writer, on another way or for another point, or its link
                was begun anew since, so that the point may be another. Nothing was sent.
            NotPolledNow: the link is not polled by this collector at this moment; nothing was sent.
            NoSuchPoint: the point is no longer in the configuration; nothing was sent.
            OSError: the journal cannot be read; nothing was sent.
        """
        if not is_key(key):
            raise NoSuchCommand(_NOT_ARMED)
        armed = self._armed.get(key)
        if armed is not None:
            command = armed.command
            if command.by != by:
                raise InvalidRequest(f"{command.by} has armed it, and has to confirm it")
            if origin not in (None, command.origin):
                raise InvalidRequest(f"it was armed by way of {command.origin}, and has to be confirmed on that way")
            _check_place(command, point)
            del self._armed[key]
            if self._targets.target(command.device, command.point).poller is not armed.poller:
                raise InvalidRequest(_begun_anew(command))
            left = min(seconds, armed.until - self._moment())
            return await self._submit(command, replace(rights, has_armed=True), left, armed.poller)
        running = self._running.get(key)
        if running is not None:
            _check_place(running.command, point)
            return await asyncio.shield(running.task)
        found = await self._in_thread(self._journal.find, key)
        if found is None:
            raise NoSuchCommand(_NOT_ARMED)
        _check_place(found.command, point)
        return self._unrecorded.get(key, found)

    async def newest(self, limit: int) -> list[CommandResult]:
        """Return the results of the commands recorded last, newest first, ``limit`` at most; open ones too.

        Raises:
            OSError: the journal cannot be read.
        """
        found = await self._in_thread(self._journal.newest, limit)
        return [self._unrecorded.get(each.command.key, each) for each in found]

    # Taking one.

    async def _submit(
        self,
        command: PointCommand,
        rights: WriterRights,
        seconds: float = math.inf,
        poller: LinkPoller | None = None,
    ) -> CommandResult:
        """Execute a command and return its result; if the same command is in execution, wait for that one instead.

        The command is refused if the collector ends or too many commands are open.

        Args:
            command: the command.
            rights: what its writer may do.
            seconds: seconds from now within which it may be sent; its expiry holds too.
            poller: the poller that the device had when the command was armed; None for any.
        """
        left = min(seconds, command.expires - self._now())
        permission = _Permission(rights, poller, asyncio.get_running_loop().time() + left)
        joined = await self._joined(command)
        if joined is not None:
            return joined
        lock, waiting = self._devices.get(command.device, (asyncio.Lock(), 0))
        if self._closed:
            return await self._refused_now(command, "the collector ends")
        if waiting >= MOST_OPEN:
            return await self._refused_now(command, f"{waiting} commands of {command.device} are open")
        if len(self._running) >= MOST_OPEN_IN_ALL:
            return await self._refused_now(command, f"{len(self._running)} commands of all devices are open")
        self._devices[command.device] = lock, waiting + 1
        task = asyncio.create_task(self._take(command, lock, permission), name=f"busway command {command.key}")
        self._running[command.key] = _Running(command, task)
        task.add_done_callback(lambda _: self._leave(command))
        return await asyncio.shield(task)

    def _leave(self, command: PointCommand) -> None:
        self._running.pop(command.key, None)
        lock, waiting = self._devices[command.device]
        if waiting > 1:
            self._devices[command.device] = lock, waiting - 1
        else:
            del self._devices[command.device]

    async def _take(self, command: PointCommand, lock: asyncio.Lock, permission: _Permission) -> CommandResult:
        """Check and record a command, send it, and record its result (rules 1 and 2); return the result.

        Args:
            command: the command.
            lock: the lock of the device, held while one of its commands is sent and read back.
            permission: rights and limits of the command.
        """
        result = self._result(command)
        try:
            refusal = self._refusal(command, permission)
        except NotPolledNow as error:
            return await self._refused_now(command, error.message)
        if refusal:
            result = result.finished(CommandState.REFUSED, refusal)
        elif self._left(command, permission.until) <= 0:
            result = result.finished(CommandState.EXPIRED, "its time was over; nothing was sent")
        elif not self._audit.takes_writes:
            return await self._refused_now(command, "the audit log cannot be written")
        try:
            known = await self._recorded(result)
        except (OSError, Overloaded, KeysUnavailable) as error:
            return self.refused(result, f"it cannot be recorded; nothing was sent: {error}")
        if known is not None:
            return self._of_first(command, known)
        self._running[command.key].has_taken = True
        if result.state is not CommandState.OPEN:
            self._append(result)
            return self._notify(result)
        self._step("claimed")
        async with lock:
            result = await self._send_guarded(result, permission)
        self._step("answered")
        self._append(result)
        try:
            await self._in_thread(self._finish, result)
        except OSError as error:
            self._unrecorded[command.key] = result
            _log.error("the result of a command is kept in memory: %s", error)
        if self._claims is not None:
            await self._claims.finish(result)
        self._step("recorded")
        return self._notify(result)

    async def _recorded(self, result: CommandResult) -> CommandResult | None:
        """Record a command under its key, in a fleet for all collectors first, unless the key was used before.

        Returns:
            None if it is recorded now; else the recorded result of the first command with this key.

        Raises:
            OSError, Overloaded, KeysUnavailable: it is not recorded, and must not be sent.
        """
        if self._claims is not None:
            known = await self._in_thread(self._journal.known, result)
            known = await self._claims.claim(result) if known is None else known
            if known is not None:
                return known
        try:
            return await self._in_thread(self._journal.take, result)
        except (OSError, Overloaded) as error:
            if self._claims is not None:
                why = f"it could not be recorded; nothing was sent: {error}"
                await self._claims.finish(result.finished(CommandState.REFUSED, why))
            raise

    def _left(self, command: PointCommand, until: float) -> float:
        """Return the seconds in which a command may still be sent; 0 or less if its time is over.

        They end at its expiry by the wall clock, or at ``until`` by the clock of the event loop, whichever comes first.
        """
        return min(until - asyncio.get_running_loop().time(), command.expires - self._now())

    async def _refused_now(self, command: PointCommand, why: str) -> CommandResult:
        """Refuse a command without recording it, so that it may be sent again later.

        If its key was used before, return the result of the first command with this key instead.
        """
        try:
            known = await self._known(command)
        except OSError as error:
            return self._refused_unread(command, why, error)
        return known or self.refused(self._result(command), f"{why}; nothing was sent")

    def _refused_unread(self, command: PointCommand, why: str, error: OSError) -> CommandResult:
        """Refuse a command whose key cannot be looked up; the reason leaves open whether it was sent before."""
        why = f"{why}, and whether its key was used before cannot be read: {error}"
        return self.refused(self._result(command), why)

    async def _known(self, command: PointCommand) -> CommandResult | None:
        """Return the result for a command whose key was used before; None for a new key, or one made by the collector.

        If a command with this key runs, wait for its end.

        Raises:
            OSError: the journal cannot be read.
        """
        if command.key.startswith(MADE):
            return None
        while True:
            joined = await self._joined(command)
            if joined is not None:
                return joined
            known = await self._in_thread(self._journal.known, self._result(command))
            if known is None and self._claims is not None:
                known = self._claims.known(self._result(command))
            if known is not None:
                return self._of_first(command, known)
            if self._other_running(command) is None:
                return None

    async def _joined(self, command: PointCommand) -> CommandResult | None:
        """Wait for a running command with the same key, and return its result; None if none is running.

        If the running command writes another value or point, return a refusal at once if its key is recorded; else wait
        for its end, and look again.
        """
        while (running := self._other_running(command)) is not None:
            if running.command.is_same(command):
                return await asyncio.shield(running.task)
            if running.has_taken:
                return self._refused_other(command, running.command)
            await asyncio.wait([running.task])  # the key may be that of an earlier command, which was this one
        return None

    def _other_running(self, command: PointCommand) -> _Running | None:
        running = self._running.get(command.key)
        return None if running is None or running.task is asyncio.current_task() else running

    def _of_first(self, command: PointCommand, known: CommandResult) -> CommandResult:
        """Return the recorded result of the first command with the same key; a refusal if that was another command."""
        known = self._unrecorded.get(command.key, known)
        return known if known.command.is_same(command) else self._refused_other(command, known.command)

    def _result(self, command: PointCommand) -> CommandResult:
        return CommandResult(command, CommandState.OPEN, self._now(), self._targets.last(command.device, command.point))

    def _refused_other(self, command: PointCommand, first: PointCommand) -> CommandResult:
        why = f"this key was used for another command, {first.device}/{first.point} = {shown(first.value)}"
        return self.refused(self._result(command), f"{why}; nothing was sent")

    def _finish(self, result: CommandResult) -> None:
        self._record_unrecorded()
        self._journal.finish(result)

    def _record_unrecorded(self) -> None:
        """Record results of commands that could not be recorded before, until one fails. For the journal's thread."""
        for key, result in list(self._unrecorded.items()):
            try:
                self._journal.finish(result)
            except OSError:
                return
            del self._unrecorded[key]

    async def _in_thread(self, function: Callable[..., _T], *values: object) -> _T:
        """Call a function of the journal in its thread. Raises `OSError`, as the function may, if `close` has ended."""
        if self._has_ended:
            raise OSError("it is closed")
        return await asyncio.get_running_loop().run_in_executor(self._thread, function, *values)

    def _append(self, result: CommandResult) -> None:
        """Append the line of a command's result to the audit log, and have it written to the file at once."""
        self._audit.append(command_line(result, self._audit.timestamp()))
        self._audit.flush()

    def _notify(self, result: CommandResult) -> CommandResult:
        for told in self._subscribers:
            try:
                told(result)
            except Exception:  # what subscribers raise is theirs: the command has ended, and its caller gets the result
                _log.exception("a subscriber of commands failed")
        return result

    def refused(self, result: CommandResult, reason: str) -> CommandResult:
        """Return a refusal as the result of a command. It goes to the audit log, and not to the journal.

        Repeated refusals with the same origin, person and device are counted in the audit log, without a line for each.

        Args:
            result: the command, as an open result.
            reason: why it is refused, as a sentence.
        """
        refused = result.finished(CommandState.REFUSED, reason)
        about = (result.command.origin, result.command.by, result.command.device)
        time = self._audit.timestamp()
        self._audit.append_denied(about, lambda repeated: command_line(refused, time, repeated))
        return refused

    # Deciding.

    def _refusal(self, command: PointCommand, permission: _Permission) -> str:
        """Return why a command must be refused, as a sentence; empty if it need not. Whether it is late is not checked.

        Raises:
            NotPolledNow: the link is not polled by this collector at this moment.
        """
        try:
            self._planned(command, permission)
        except NotPolledNow:
            raise
        except InvalidRequest as error:
            return error.message
        if command.expires - self._now() > LONGEST_SECONDS:
            return f"expires is further away than {LONGEST_SECONDS:g} s; nothing was sent"
        return ""

    def _planned(self, command: PointCommand, permission: _Permission) -> tuple[PointWrite, LinkPoller]:
        """Check whether a command can be sent now, and return its write and the poller of its link.

        Raises:
            InvalidRequest: it is against a rule, its device is in maintenance or does not answer, its link was begun
                anew, or its scale was not read when due. Nothing was sent.
            NotPolledNow: the link is not polled by this collector at this moment.
        """
        target = self._targets.target(command.device, command.point)
        refusal = permission.rights.refusal(target.point.writing)
        if refusal:
            raise InvalidRequest(f"{command.device}/{command.point} {refusal}")
        if permission.poller not in (None, target.poller):
            raise InvalidRequest(_begun_anew(command))
        if target.is_broadcast:
            raise InvalidRequest(f"{command.device} has unit 0, which all devices of a line obey; nothing was sent")
        if target.is_absent:
            raise InvalidRequest(f"{command.device} does not have {command.point} now; nothing was sent")
        if _is_in_maintenance(target.poller, command.device):
            raise InvalidRequest(f"{command.device} is in maintenance; nothing was sent")
        scheduled = target.poller.schedule.devices.get(command.device)
        device = target.poller.devices[command.device]
        if scheduled is not None and scheduled.lives is False:
            error = f": {device.last_error}" if device.last_error else ""
            raise InvalidRequest(f"{command.device} does not answer; nothing was sent{error}")
        factor = target.point.conversion.scale_from
        if factor and target.poller.is_factor_held(command.device, factor):
            raise InvalidRequest(f"{factor}, the scale of {target.point.name}, was not read when due; nothing was sent")
        return point_write(target.point, command.value, device.scale_factors, target.rules), target.poller

    # Sending.

    async def _send_guarded(self, result: CommandResult, permission: _Permission) -> CommandResult:
        try:
            return await self._send(result, permission)
        except Exception:  # a defect: it may have been sent, so its end is recorded and told as unknown, not lost
            _log.exception("a command ended by a defect")
            return result.finished(CommandState.UNKNOWN, "a defect of this program, which its log shows")

    async def _send(self, result: CommandResult, permission: _Permission) -> CommandResult:
        command = result.command
        try:
            # Anew: others went before, and the file may have been read again.
            write, poller = self._planned(command, permission)
        except InvalidRequest as error:
            return result.finished(CommandState.FAILED, error.message)
        turn = _WriteTurn(write, poller, command.device, lambda: self._left(command, permission.until))
        try:
            state, reason = await _in_turn(poller, command.device, turn.make)
        except Overloaded as error:
            return result.finished(CommandState.FAILED, f"nothing was sent: {error}")
        except _LinkEnded:
            if turn.has_begun:
                return result.finished(CommandState.UNKNOWN, "the link was closed before the answer came")
            return result.finished(CommandState.FAILED, "the link was closed; nothing was sent")
        result = result.finished(state, reason, old=self._held_before(turn))
        if state is not CommandState.DONE or write.shown is None:
            return result
        return await self._confirmed(result, write, poller)

    def _held_before(self, turn: "_WriteTurn") -> OldValue | None:
        return None if turn.before is None else OldValue(turn.before, Quality.GOOD.label, self._now())

    async def _confirmed(self, result: CommandResult, write: PointWrite, poller: LinkPoller) -> CommandResult:
        """Read a written point back, after each pause of `SHOWN_AFTER`, until the device shows the value.

        Returns the result of the command: done if the value is shown. Else the last read decides: failed if it showed
        another value, unknown if it failed. Unknown also if the link is closed before.
        """
        value: CommandValue | None = None
        problem: ModbusError | None = None
        turn = _ReadTurn(write, poller, result.command.device)
        for pause in SHOWN_AFTER:
            await asyncio.sleep(pause)
            try:
                is_shown, value = await _in_turn(poller, result.command.device, turn.make)
            except _LinkEnded:
                return result.finished(
                    CommandState.UNKNOWN, "the device has answered, but the link was closed before it was read back"
                )
            except ModbusError as error:
                problem = error
                continue
            if is_shown:
                return result.finished(CommandState.DONE, result.reason, read_back=value)
            problem = None
        if problem is not None:
            return result.finished(
                CommandState.UNKNOWN, f"the device has answered, but could not be read back: {problem}"
            )
        return result.finished(
            CommandState.FAILED,
            f"the device has answered, but shows {shown(value)}, not {shown(result.command.value)}",
            read_back=value,
        )


class _WriteTurn:
    """The turn on a link in which a command's write is sent, after a read if the point is only a part of its register.

    Attributes:
        has_begun: whether the write may have been sent.
        before: the point's value as it was read in this turn before the write; None if it was not read or had none.
    """

    def __init__(self, write: PointWrite, poller: LinkPoller, device: str, left: Callable[[], float]) -> None:
        self._write, self._poller, self._device, self._left = write, poller, device, left
        self.has_begun: bool = False
        self.before: CommandValue | None = None

    async def make(self) -> tuple[CommandState, str]:
        """Send the write, after a read if the point is only a part of its register; return its state and reason.

        No write is sent if the command's time is over, the device is in maintenance, or the read failed. Sets
        ``before`` and ``has_begun``.
        """
        held = b""
        if self._left() <= 0:
            return CommandState.EXPIRED, "its time was over before it was its turn; nothing was sent"
        if _is_in_maintenance(self._poller, self._device):
            return CommandState.FAILED, f"{self._device} is in maintenance; nothing was sent"
        if self._write.before is not None:
            try:
                held = await _read(self._poller, self._device, self._write.before, self._left())
            except ModbusError as error:
                return CommandState.FAILED, f"the register could not be read before; nothing was sent: {error}"
            self.before = self._write.held_value(held)
            await self._poller.wait_for(self._device)  # its pause after each reply may be longer than what is left
            if self._left() <= 0:
                return CommandState.EXPIRED, "its time was over while the register was read; nothing was sent"
            if _is_in_maintenance(self._poller, self._device):  # it began meanwhile, and people may work there now
                return CommandState.FAILED, f"{self._device} is in maintenance; nothing was sent"
        self.has_begun = True
        return judged(await _asked(self._poller, self._device, self._write.request(held), self._left()))


class _ReadTurn:
    """The turn on a link in which a written point is read back."""

    def __init__(self, write: PointWrite, poller: LinkPoller, device: str) -> None:
        self._write, self._poller, self._device = write, poller, device

    async def make(self) -> tuple[bool, CommandValue | None]:
        """Read once the place where the device shows the written value.

        If that place is the point itself, the value becomes a sample of the point too, unless the device has come into
        maintenance meanwhile.

        Returns:
            Whether the device shows the written value, and the value that it shows.

        Raises:
            ModbusError: the point could not be read, or its device is in maintenance.
        """
        write = self._write
        assert write.shown is not None
        if _is_in_maintenance(self._poller, self._device):
            raise InvalidRequest(f"{self._device} is in maintenance")
        began = asyncio.get_running_loop().time()
        is_shown, found = write.shows(await _read(self._poller, self._device, write.shown, math.inf))
        if write.shown.point is write.point and not _is_in_maintenance(self._poller, self._device):
            self._poller.note_reading(self._device, write.point, found, began)
        return is_shown, plain(found.value)


def _begun_anew(command: PointCommand) -> str:
    return f"the link of {command.device} was begun anew since this was armed; arm it anew; nothing was sent"


def _check_place(command: PointCommand, point: tuple[str, str] | None) -> None:
    """Raise `InvalidRequest` if a command to be confirmed is not for this device and point; None permits any point."""
    if point is not None and (command.device, command.point) != point:
        raise InvalidRequest(f"it was armed for {command.device}/{command.point}; nothing was sent")


def _is_in_maintenance(poller: LinkPoller, device: str) -> bool:
    scheduled = poller.schedule.devices.get(device)
    return scheduled is not None and scheduled.is_paused


async def _read(poller: LinkPoller, device: str, read: PointRead, seconds: float) -> bytes:
    """Read one point of a device, and return the bytes of its registers, or for a bit one byte, 0 or 1.

    ``seconds`` is the deadline of the read, as for `_asked`.

    Raises:
        ModbusError: it could not be read.
    """
    reply = await _asked(poller, device, read.request, seconds)
    if isinstance(reply, ModbusError):
        raise reply
    return read.own(reply.data)


async def _asked(poller: LinkPoller, device: str, request: Request, seconds: float) -> Any:  # a reply or an error
    """Send one request to a device, once; return the reply, or the error instead of raising it.

    Waits first for the pause that the device needs between two requests, and begins the next pause afterwards.
    ``seconds`` is the deadline of the request after that pause; infinite for none.
    """
    # `idempotent` with no retries: else `write_retries` of the link would repeat a write.
    options: dict[str, Any] = {"timeout": poller.schedule.timeout, "retries": 0, "idempotent": True}
    if seconds < math.inf:
        options["deadline"] = seconds
    await poller.wait_for(device)
    try:
        (outcome,) = await poller.link.run(poller.devices[device].unit, [request], options)
    except ModbusError as error:
        outcome = error
    poller.note_asked(device)
    return outcome


async def _in_turn(poller: LinkPoller, device: str, make: Callable[[], Awaitable[_T]]) -> _T:
    """Have the poller of a link call ``make`` before its next reads, and return the result of ``make``.

    Raises:
        Overloaded: too many writes wait for the link; nothing was sent.
        _LinkEnded: polling of the link ended before ``make`` was called, or while it ran.
        Exception: what ``make`` raises.
    """
    future: asyncio.Future[_T] = asyncio.get_running_loop().create_future()

    async def perform() -> None:
        try:
            made = await make()
        except asyncio.CancelledError:
            _fail(future, _LinkEnded())
            raise
        except Exception as error:  # defects too: the command waits for this future, and raises what it gets
            _fail(future, error)
        else:
            if not future.done():
                future.set_result(made)

    if not poller.write(device, perform, lambda: _fail(future, _LinkEnded())):
        raise Overloaded("the link takes no further write now")
    return await future


def _fail(future: "asyncio.Future[_T]", error: Exception) -> None:
    if not future.done():
        future.set_exception(error)


def _text(value: CommandValue | None, point: Point) -> str:
    """Return a value of a point as text for people: with its name if it has one, else with the unit of measure.

    None becomes ``unknown``, a state without a name ``on`` or ``off``.
    """
    unit, name = point.unit_of_measure, point.label(value)
    if name:
        return f"{name} ({value})"
    if value is None or isinstance(value, bool):
        return "unknown" if value is None else "on" if value else "off"
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return f"{text} {unit}" if unit and not isinstance(value, str) else text
