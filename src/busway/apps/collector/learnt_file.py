"""The file beside the store in which a collector keeps what it learns about devices, over restarts.

Knows one file; `knowledge` defines its contents.
"""

from pathlib import Path

from ...config.file_text import read_text
from ...safe_files import write_whole
from .knowledge import Knowledge, read_knowledge


class LearntFile:
    """The file in which a collector keeps what it learns about devices, to use it after a restart.

    Attributes:
        path: path of the file, which need not exist.
    """

    def __init__(self, path: Path) -> None:
        self.path: Path = path
        self._written = ""

    def read(self) -> Knowledge:
        """Return what earlier runs learnt about the devices; empty if there is no file.

        Raises:
            ConfigError: the file cannot be read, or does not hold what a collector writes.
        """
        return read_knowledge(read_text(str(self.path)), str(self.path)) if self.path.exists() else Knowledge()

    def write(self, text: str) -> None:
        """Replace the whole file by a text (`Knowledge.text`); do nothing if the text is the one written last.

        Waits for the disk.

        Raises:
            OSError: the file cannot be written; it is as before.
        """
        if text != self._written:
            write_whole(self.path, text)
            self._written = text
