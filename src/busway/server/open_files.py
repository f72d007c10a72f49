"""The system's limit of open files, which limits connections: each needs one, and 1024 is a common limit."""

import sys


def raise_open_file_limit() -> None:
    """Raise the process's soft limit of open files to its hard limit; no effect on systems without such limits."""
    if sys.platform == "win32":
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < hard:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
