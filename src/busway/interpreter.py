"""Check that this Python interpreter is supported; done once, when the package is imported.

Knows the interpreter; knows nothing of busway.

Stores, queues and caches of busway rely on the interpreter's lock (GIL), which makes operations of built-in types
atomic. On a build without that lock (PEP 703) a read could see half of a write, and no test has ever run on one.
"""

import sys


def refuse_free_threading() -> None:
    """Refuse an interpreter built to run without the global interpreter lock, even if the lock is enabled now.

    Raises:
        ImportError: the interpreter is such a build; the message says which build to use.
    """
    is_enabled = getattr(sys, "_is_gil_enabled", None)
    if (is_enabled is not None and not is_enabled()) or "t" in getattr(sys, "abiflags", ""):
        version = ".".join(str(number) for number in sys.version_info[:2])
        raise ImportError(
            f"busway does not run on a free-threaded Python: its data would not be safe without the interpreter's lock,"
            f" and it was never tested there; use the usual build of Python {version} (python{version}, not"
            f" python{version}t)",
            name="busway",
        )
