"""A nats-server with JetStream on a folder of its own, until SIGTERM. Says `port N` once it takes connections."""

import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time

START = 10.0


def main() -> None:
    program = shutil.which("nats-server", path="/usr/sbin:/usr/bin:/usr/local/bin")
    if program is None:
        sys.exit("nats-server is not installed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [program, "-a", "127.0.0.1", "-p", str(port), "-js", "-sd", folder], stderr=subprocess.DEVNULL
        )
        try:
            until = time.monotonic() + START
            while not _answers(port) and process.poll() is None and time.monotonic() < until:
                time.sleep(0.02)
            if not _answers(port):
                sys.exit("nats-server does not take connections")
            print(f"port {port}", flush=True)
            process.wait()
        finally:
            process.terminate()
            process.wait(5)


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


if __name__ == "__main__":
    main()
