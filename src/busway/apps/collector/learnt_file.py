"""The file beside the store in which a collector keeps what it learns about devices, over restarts.

Knows one file; what is in it is known by `knowledge`.
"""

from pathlib import Path

from ...config.reading import read_text
from ...safe_files import write_whole
from .knowledge import Knowledge, read_knowledge


class LearntFile:
    """The file in which a collector keeps what it learns about devices.

    Attributes:
        path: the path of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path: Path = path
        self._written = ""

    def read(self) -> Knowledge:
        """Return what earlier runs learnt about the devices; empty if there is no file. Raises `ConfigError`."""
        return read_knowledge(read_text(str(self.path)), str(self.path)) if self.path.exists() else Knowledge()

    def write(self, text: str) -> None:
        """Replace the file whole with `Knowledge.text`, unless that was written last. Waits for the disk.

        Raises:
            OSError: the file is as it was.
        """
        if text != self._written:
            write_whole(self.path, text)
            self._written = text
