"""What a server program of the benchmark says about itself, so that ours and the peers' answer the harness alike.

Rules (those of the servers in C, and one more):
1. `port N` on the first line, once it listens.
2. SIGUSR1: `cpu S`, seconds of user and system time so far.
3. SIGUSR2, for Python programs started with --trace-memory: `traced N`, bytes that living Python objects hold.
"""

import gc
import signal
import time
import tracemalloc
from types import FrameType


def trace_memory() -> None:
    """Starts counting the bytes of Python objects; call it before the objects of interest exist."""
    tracemalloc.start(1)


def port(number: int) -> None:
    """Tells the port and answers the two signals from now on."""
    signal.signal(signal.SIGUSR1, _tell_cpu)
    signal.signal(signal.SIGUSR2, _tell_traced)
    print(f"port {number}", flush=True)


def _tell_cpu(number: int, frame: FrameType | None) -> None:
    print(f"cpu {time.process_time():.6f}", flush=True)


def _tell_traced(number: int, frame: FrameType | None) -> None:
    gc.collect()
    print(f"traced {tracemalloc.get_traced_memory()[0]}", flush=True)
