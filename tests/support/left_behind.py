"""What programs have left in a folder that they had as TMPDIR."""

import os
from pathlib import Path


def left_in(folder: Path) -> list[Path]:
    """All that is there, but for the directory of control sockets, which programs share and which stays."""
    return [each for each in folder.rglob("*") if each != folder / f"busway-{os.getuid()}"]
