"""``busway points``: converts descriptions of devices from other programs into device files.

1. The device file goes to stdout or into a file. What could not be carried over goes to stderr, one line each, and into
   comments at the top of the device file.
2. An existing file is overwritten with ``--force`` only.
"""

import os

import typer

from ..errors import ConfigError
from .arguments import whole_number
from .exits import ExitCode
from .files import refuse_to_replace, write_new
from .output import warn

EXAMPLES = """\b
Examples:
  busway points convert telegraf.toml --out meter.toml
  busway points convert configuration.yaml
  busway points convert model_160.json --address 40070 > inverter.toml
  busway points convert model_705.json --count NCrv=3 --count NPt=4
"""


def points(
    action: str = typer.Argument(..., metavar="ACTION", help="convert."),
    file: str | None = typer.Argument(None, metavar="FILE", help="What another program has: TOML, YAML, CSV, JSON."),
    kind: str | None = typer.Option(
        None, "--from", metavar="FORMAT", help="csv, telegraf, home-assistant, modpoll, sunspec; else by the name."
    ),
    out: str | None = typer.Option(
        None, "--out", metavar="FILE", help="Where the device file goes, instead of stdout."
    ),
    force: bool = typer.Option(False, "--force", help="With --out: write over a file that is there."),
    address: str = typer.Option(
        "40002", "--address", metavar="N", help="SunSpec: offset of the model's register ID: 40002."
    ),
    count: list[str] = typer.Option(
        [], "--count", metavar="NAME=N", help="SunSpec: how often a group is repeated; several times if need be."
    ),
) -> int:
    """Convert device descriptions of other programs."""
    from ..apps.importers.formats import import_file

    if action != "convert":
        raise ConfigError(f"must be convert, not {action!r}", key="ACTION")
    if file is None:
        raise ConfigError("convert needs a file", key="FILE")
    if out is not None:
        refuse_to_replace(out, force=force)
    found = import_file(
        file, format=kind, address=whole_number(address, "--address", 0, 65_535), counts=dict(map(_count, count))
    )
    text = found.text(os.path.basename(file))
    for omission in found.omissions:
        warn(f"not carried over: {omission}")
    if out is None:
        print(text, end="")
    else:
        write_new(out, text, force=force, kind="device file")
    return ExitCode.DONE


def _count(text: str) -> tuple[str, int]:
    name, equals, number = text.partition("=")
    if not equals or not name:
        raise ConfigError(f"must be written NAME=N, not {text!r}", key="--count")
    return name, whole_number(number, f"--count {name}", 1, 10_000)
