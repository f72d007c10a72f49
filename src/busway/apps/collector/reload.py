"""Replaces the configuration of a running collector, from its file or from a text that becomes its file.

Knows two configurations, a file and the audit log; the collector itself puts a new configuration into use.

1. The store cannot change while the collector runs: a configuration with another store is refused, and nothing is
   changed. What can fail in a new configuration is prepared before anything is changed (`prepare`).
2. Other settings that are read only at the start are named in the result and in the log: they take effect at the next
   start.
3. A file is replaced as a whole, and keeps its permissions: after a crash it has either the old or the new contents.
4. One change at a time. A change that has begun is completed, even if its caller is cancelled.
5. Each change, and each refused text, is a line of the audit log. A refusal before the text is parsed is not: the file
   cannot be read, another revision is in use, or the collector ends.
6. When the file was read again and refused, log and page name its wrong keys until a configuration is accepted. They
   show no values: a wrong line may hold a secret, and many people read log and page.
"""

import asyncio
import logging
import os
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import Any, Final

from ...access.audit_log import AuditLog
from ...config.file_text import read_text
from ...config.files.collector import CollectorSection
from ...config.files.file_error import FileError
from ...errors import ConfigError
from ...safe_files import write_whole
from .commands.audit import configuration_line, revision_of
from .configuration import CollectorConfiguration, parse_collector

_READ_AT_THE_START: Final = tuple(
    key
    for key in CollectorSection.model_fields
    if key not in ("store", "learn", "store_report", "keep_days", "keep_bytes")
)
"""Keys of ``[collector]`` whose changes take effect at the next start. Another `store` is refused; the others take
effect at once."""
_log = logging.getLogger("busway.collector")


class CollectorReload:
    """Replaces the configuration of a running collector, one change at a time.

    Args:
        current: returns the configuration in use.
        audit: returns the audit log; None while there is none.
        apply: puts another configuration into use, and returns the changes, each as a sentence.
        prepare: called before ``apply``: does the steps that can fail, such as binding ports, and raises `ConfigError`
            if one fails. Changes nothing that is in use.
        check: raises `ConfigError` if ``prepare`` would raise it, and changes nothing that is in use.

    Attributes:
        running: the tasks that change the configuration, or wait for their turn to do so.
        is_ending: whether `end` was called, so that every further change is refused.
        waiting: keys that have changed since the start and take effect at the next start.
        refusal: the lines and keys for which the file was refused when it was read again; empty once a configuration
            was accepted.
    """

    def __init__(
        self,
        current: Callable[[], CollectorConfiguration],
        audit: Callable[[], AuditLog | None],
        apply: Callable[[CollectorConfiguration], Awaitable[list[str]]],
        prepare: Callable[[CollectorConfiguration], None],
        check: Callable[[CollectorConfiguration], None],
    ) -> None:
        self._current, self._audit, self._apply = current, audit, apply
        self._prepare, self._check = prepare, check
        self._started_with = current()
        self._lock = asyncio.Lock()
        self.running: set[asyncio.Task[list[str]]] = set()
        self.is_ending: bool = False
        self.waiting: list[str] = []
        self.refusal: list[str] = []

    def check(self, configuration: CollectorConfiguration) -> None:
        """Raise `ConfigError` if another configuration cannot be used while the collector runs.

        Nothing that is in use changes.
        """
        _refuse_what_cannot_change(self._current(), configuration)
        self._check(configuration)

    async def reload(self, configuration: CollectorConfiguration, by: str, origin: str) -> list[str]:
        """Put another configuration into use, and return what changed, each as a sentence.

        Each key that differs from the configuration at the start and takes effect only at the next start has a sentence
        too, even if an earlier change left it so. If there is no sentence, the list is ``["nothing changed"]``. Waits
        for changes that began earlier; a change that has begun is completed even if the caller is cancelled.

        Args:
            configuration: the new configuration.
            by: who makes the change, for the audit log.
            origin: where the change comes from, for the audit log.

        Raises:
            ConfigError: the configuration cannot be used, or the collector ends; the old one stays in use.
        """
        return await self._to_its_end(self._use(configuration, by, origin))

    async def read_again(self, by: str, origin: str) -> list[str]:
        """Read the collector's file again, put it into use, and return what changed, each as a sentence.

        First the audit log is opened again, because its file may have been renamed. Arguments and result are those of
        `reload`. If the file is refused, the attribute ``refusal`` says for which lines and keys.

        Raises:
            ConfigError: the file cannot be read or used, or the collector ends; the old configuration stays in use.
        """
        return await self._to_its_end(self._read_again(by, origin))

    async def replace(self, text: str, by: str, origin: str, revision: str | None) -> list[str]:
        """Replace the contents of the collector's file, put them into use, and return what changed, each as a sentence.

        The result is that of `reload`.

        Args:
            text: the new contents of the file.
            by: who makes the change, for the audit log.
            origin: where the change comes from, for the audit log.
            revision: revision of the configuration that the caller has edited (`revision_of`), which must still be in
                use. None skips this check.

        Raises:
            ConfigError: the text cannot be used, another revision is in use, the file cannot be written, or the
                collector ends; the old configuration stays in use. The file is as before, unless something, such as a
                port, became unusable between check and use: then it has the new text.
        """
        return await self._to_its_end(self._replace(text, by, origin, revision))

    async def end(self) -> None:
        """Refuse all further changes of the configuration, waiting ones too, and wait for the change in progress."""
        self.is_ending = True
        if self.running:
            await asyncio.wait(self.running)

    async def _to_its_end(self, change: Coroutine[Any, Any, list[str]]) -> list[str]:
        """Run a change after those begun earlier, and complete it even if the caller is cancelled (rule 4)."""
        task = asyncio.create_task(self._in_turn(change), name="busway collector reload")
        self.running.add(task)
        task.add_done_callback(self.running.discard)
        return await asyncio.shield(task)

    async def _in_turn(self, change: Coroutine[Any, Any, list[str]]) -> list[str]:
        async with self._lock:
            if self.is_ending:
                change.close()
                raise ConfigError("the collector ends; its configuration stays as it is")
            return await change

    async def _read_again(self, by: str, origin: str) -> list[str]:
        audit = self._audit()
        if audit is not None:
            audit.reopen()
        try:
            text = await asyncio.to_thread(read_text, self._current().name)
            return await self._use(await self._parsed(text, by, origin), by, origin)
        except ConfigError as error:
            self.refusal = _places(error)
            _log.warning("the file was read again and refused, nothing was changed: %s", "; ".join(self.refusal))
            raise

    async def _replace(self, text: str, by: str, origin: str, revision: str | None) -> list[str]:
        in_use = revision_of(self._current().text)
        if revision is not None and revision != in_use:
            raise ConfigError(f"the configuration is {in_use} by now, not {revision}: read it again", key="revision")
        configuration = await self._parsed(text, by, origin)
        try:
            self.check(configuration)
            await asyncio.to_thread(replace_file, configuration.name, text)
        except ConfigError as error:
            self._record(text, [str(error)], False, by, origin)
            raise
        return await self._use(configuration, by, origin)

    async def _parsed(self, text: str, by: str, origin: str) -> CollectorConfiguration:
        try:
            return await asyncio.to_thread(parse_collector, text, self._current().name)
        except ConfigError as error:
            self._record(text, str(error).splitlines(), False, by, origin)
            raise

    async def _use(self, configuration: CollectorConfiguration, by: str, origin: str) -> list[str]:
        old = self._current()
        try:
            _refuse_what_cannot_change(old, configuration)
            self._prepare(configuration)
        except ConfigError as error:
            self._record(configuration.text, [str(error)], False, by, origin)
            raise
        done = await self._apply(configuration)
        self.waiting, self.refusal = left_for_the_next_start(self._started_with, configuration), []
        if self.waiting:
            _log.warning("a restart is needed: changes of %s hold after the next start", ", ".join(self.waiting))
        done = [*done, *(f"{key} holds after the next start" for key in self.waiting)]
        self._record(configuration.text, done, True, by, origin, old.text)
        return done or ["nothing changed"]

    def _record(
        self, text: str, done: Sequence[str], is_applied: bool, by: str, origin: str, old: str | None = None
    ) -> None:
        """Append a line to the audit log, if there is one, for a change or for a refused text (rule 5)."""
        audit = self._audit()
        if audit is not None:
            before = self._current().text if old is None else old
            audit.append(
                configuration_line(
                    before, text, done, is_applied=is_applied, by=by, origin=origin, time=audit.timestamp()
                )
            )


class NeedsRestart(ConfigError):
    """Error: a new configuration changes a key that cannot change while the collector runs."""


def _places(error: ConfigError) -> list[str]:
    """Return the lines and keys for which a file was refused, without their values (rule 6)."""
    if isinstance(error, NeedsRestart):
        return [f"{error.key}: {error.message}"]
    problems = error.problems if isinstance(error, FileError) else [error]
    return [
        ": ".join(filter(None, [f"line {each.line}" if each.line else "", each.key])) or "it cannot be read"
        for each in problems
    ]


def _refuse_what_cannot_change(old: CollectorConfiguration, new: CollectorConfiguration) -> None:
    """Raise `NeedsRestart` if a new configuration has another store than the one in use."""
    if new.store != old.store:
        raise NeedsRestart(
            "the store cannot be another while the collector runs: restart it", file=new.name, key="store"
        )


def left_for_the_next_start(started: CollectorConfiguration, new: CollectorConfiguration) -> list[str]:
    """Return the keys that differ between two configurations and take effect only at the next start; empty if none.

    Args:
        started: the configuration with which the collector was started.
        new: the configuration in use now.
    """
    before, after = started.file.collector, new.file.collector
    keys = [f"[collector] {key}" for key in _READ_AT_THE_START if getattr(before, key) != getattr(after, key)]
    if started.file.audit != new.file.audit:
        keys.append("[audit]")
    if started.file.page_access != new.file.page_access:
        keys.append("[page_access]")
    return keys


def replace_file(path: str, text: str) -> None:
    """Replace the whole contents of an existing file, which keeps its permissions (rule 3); a symbolic link stays one.

    Raises:
        ConfigError: the file cannot be written; its contents are as before.
    """
    target = os.path.realpath(path)
    try:
        write_whole(target, text, like=os.stat(target))
    except OSError as error:
        raise ConfigError(f"cannot be replaced: {error.strerror}", file=path) from error
