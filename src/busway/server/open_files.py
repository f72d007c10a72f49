"""The system's limit of open files, which limits connections: each needs one, and 1024 is a common limit."""

import sys


def raise_open_file_limit() -> None:
    """Raise the process's soft limit of open files to the hard limit, on systems that have them."""
    if sys.platform == "win32":
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < hard:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
