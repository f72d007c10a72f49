"""A file system that becomes full while a collector writes, and has room again."""

import json
import os
import subprocess
import sys
from pathlib import Path

import full_disk
import pytest
from foreign_servers import needed


def test_polling_goes_on_the_store_says_so_what_is_lost_is_counted_and_it_recovers(tmp_path: Path) -> None:
    unshare = needed("unshare")
    tried = subprocess.run([unshare, "-Urm", "true"], capture_output=True, text=True, check=False)
    if tried.returncode:
        reason = f"a file system of its own is not permitted here: {tried.stderr.strip()}"
        if os.environ.get("BUSWAY_REQUIRE_PEERS") == "1" and os.geteuid() == 0:
            pytest.fail(reason)
        pytest.skip(reason)
    script = f"mount -t tmpfs -o size=6m tmpfs {tmp_path} && exec {sys.executable} {full_disk.__file__} {tmp_path}"
    ended = subprocess.run(
        [unshare, "-Urm", "sh", "-c", script], capture_output=True, text=True, timeout=100, check=False
    )
    assert ended.returncode == 0, ended.stderr
    found = json.loads(ended.stdout)
    assert found["flushed"]
    assert found["error now"] is None
    assert any("full" in error or "space" in error or "I/O" in error for error in found["error then"])
    assert found["lost"] > 0
    assert found["in gaps"] == found["lost"]
    assert found["kept"] + found["lost"] == found["made"]
    assert found["twice"] == 0
    assert found["problems"] == []
    assert found["slowest"] < 1.0, "adding a sample waits for no disk"
