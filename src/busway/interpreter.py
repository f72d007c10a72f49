"""Check that this Python interpreter is supported; done once, when the package is imported.

Knows the interpreter; knows nothing of busway.

Stores, queues and caches here rely on operations of built-in types that are one step under the interpreter's lock. A
build without that lock (PEP 703) would read halves of a write now and then, and no test has ever run there.
"""

import sys


def refuse_free_threading() -> None:
    """Refuse an interpreter that was built to run without the global interpreter lock, whether or not it is on now.

    Raises:
        ImportError: it is one; the sentence says what to use.
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
