"""What the benchmark asks the operating system: cores, CPU time and memory of a process, a description for the result.

Knows Linux (`/proc`, CPU clocks of other processes, affinity) and falls back to less exact sources elsewhere.
Must not know what is measured.
"""

import os
import platform
import resource
import subprocess
import time
from pathlib import Path

CPU_CLOCK_OF_PROCESS = 2  # CPUCLOCK_SCHED: nanoseconds, all threads, the ended ones included (clock_getcpuclockid(3))


def two_cores() -> tuple[int | None, int | None]:
    """The core for servers and the one for load; (None, None) where there are not two, and nothing is pinned."""
    if not hasattr(os, "sched_getaffinity"):
        return None, None
    cores = sorted(os.sched_getaffinity(0))
    return (cores[0], cores[1]) if len(cores) > 1 else (None, None)


def cpu_seconds(pid: int) -> float:
    """CPU time (user + system, seconds) that the living process `pid` used so far."""
    try:
        return time.clock_gettime((~pid << 3) | CPU_CLOCK_OF_PROCESS)
    except (OSError, OverflowError, AttributeError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_bytes(pid: int) -> int:
    """Resident memory of `pid`, in bytes, as the kernel counts it (pages)."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    raise LookupError(f"process {pid} shows no resident memory")


def raise_file_limit() -> int:
    """Raises the soft limit of open files to the hard one, for this process and its children; returns it."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return hard


def description() -> dict[str, object]:
    """The machine and the state of the checkout, for the file of results and the head of the printed tables."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.release().partition('-')[0]}",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "load_average": round(os.getloadavg()[0], 2),
        "revision": _revision(),
    }


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def _revision() -> str:
    here = Path(__file__).parent
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=here, capture_output=True, text=True, check=False
        )
    except OSError:
        return "unknown"
    return found.stdout.strip() or "unknown"
