"""Replaces the configuration of a running collector: what may not change, and the replacement of the file.

Knows two configurations and a file; knows no link.

1. Store and sinks are those of the start: another one is refused, and nothing is changed.
2. Other settings that are read at the start alone are named: they hold after the next start.
3. A file is replaced whole, with the rights that it had: after a crash it is as before or as after.
"""

import os
from typing import Final

from ...config.files.collector import CollectorSection
from ...errors import ConfigError
from ...safe_files import write_whole
from .configuration import CollectorConfiguration

_READ_AT_THE_START: Final = tuple(
    key for key in CollectorSection.model_fields if key not in ("store", "learn", "store_report")
)
"""Keys of ``[collector]``; another store is refused, `learn` and `store_report` hold at once."""


def refuse_what_cannot_change(old: CollectorConfiguration, new: CollectorConfiguration) -> None:
    """Raise `ConfigError` if a new configuration has another store or other sinks."""
    if new.file.sink != old.file.sink:
        raise ConfigError("sinks cannot change while the collector runs: restart it", file=new.name, key="sink")
    if new.store != old.store:
        raise ConfigError(
            "the store cannot be another while the collector runs: restart it", file=new.name, key="store"
        )


def left_for_the_next_start(started: CollectorConfiguration, new: CollectorConfiguration) -> list[str]:
    """Return sentences about changes of the configuration that take effect only at the next start."""
    before, after = started.file.collector, new.file.collector
    keys = [f"[collector] {key}" for key in _READ_AT_THE_START if getattr(before, key) != getattr(after, key)]
    if started.file.audit != new.file.audit:
        keys.append("[audit]")
    if started.file.page_access != new.file.page_access:
        keys.append("[page_access]")
    return [f"{key} holds after the next start" for key in keys]


def replace_file(path: str, text: str) -> None:
    """Replace the contents of a file that exists (rule 3). Raises `ConfigError`; then it is as before."""
    target = os.path.realpath(path)
    try:
        write_whole(target, text, like=os.stat(target))
    except OSError as error:
        raise ConfigError(f"cannot be replaced: {error.strerror}", file=path) from error
