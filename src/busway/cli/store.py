"""``busway store``: checks, backs up and restores a store of the collector, also while it is being written."""

from pathlib import Path

import typer

from ..errors import ConfigError
from ..values.counts import counted
from .exits import ExitCode
from .output import say_problems

EXAMPLES = """\b
Examples:
  busway store check data
  busway store backup data /mnt/backup/data-2026-11-22
  busway store restore /mnt/backup/data-2026-11-22 data
"""


def store(
    action: str = typer.Argument(..., metavar="ACTION", help="check, backup or restore."),
    folder: str = typer.Argument(..., metavar="STORE", help="The folder of the store; of the backup for restore."),
    target: str | None = typer.Argument(
        None, metavar="TARGET", help="backup, restore: a folder that is not there yet."
    ),
) -> int:
    """Check, back up or restore a store."""
    from ..apps.collector.store.backup import back_up, restore
    from ..apps.collector.store.check import check_store_files

    if action not in ("check", "backup", "restore"):
        raise ConfigError(f"must be check, backup or restore, not {action!r}", key="ACTION")
    if (target is None) != (action == "check"):
        raise ConfigError("is needed for backup and restore, and for nothing else", key="TARGET")
    if action == "check":
        problems = check_store_files(Path(folder))
        if problems:
            say_problems(f"{folder} has {counted(len(problems), 'problem')}:", "\n".join(problems))
            return ExitCode.BROKEN
        print(f"{folder} is whole")
        return ExitCode.DONE
    assert target is not None
    copy = back_up if action == "backup" else restore
    count = copy(Path(folder), Path(target))
    print(f"{counted(count, 'part', 'is')} in {target}")
    return ExitCode.DONE
