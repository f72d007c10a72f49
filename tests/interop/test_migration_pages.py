"""The tables of the migration pages, both columns: the other program and busway get the same."""

import json
import re
import shlex
import shutil
import subprocess
import sys

import foreign
from migration_tables import called, calls_of, device_of

ASKER = """
import json, sys
from pyModbusTCP.client import ModbusClient
from pyModbusTCP.utils import decode_ieee, get_list_2comp, word_list_to_long
c = ModbusClient("127.0.0.1", int(sys.argv[1]), unit_id=1)
print(json.dumps([eval(call) for call in json.loads(sys.argv[2])]))
"""


def test_pymodbustcp_and_busway_give_the_same_call_by_call() -> None:
    if not foreign.PEER_PYTHON.exists():
        foreign.missing("no pyModbusTCP (make peers)")
    name = "migrate-from-pymodbustcp.md"
    theirs, ours = zip(*calls_of(name), strict=True)
    with device_of(name) as endpoint:
        told = run(foreign.PEER_PYTHON, "-c", ASKER, endpoint.rpartition(":")[2], json.dumps(theirs))
    with device_of(name) as endpoint:
        results = called(list(ours), endpoint)
    assert json.loads(told) == [True if result is None else result for result in results]


def test_mbpoll_and_busway_read_the_same_line_by_line() -> None:
    if shutil.which("mbpoll") is None:
        foreign.missing("no mbpoll (Debian: mbpoll)")
    name = "migrate-from-mbpoll.md"
    with device_of(name) as endpoint:
        port = endpoint.rpartition(":")[2]
        for theirs, ours in calls_of(name):
            told = run("mbpoll", "-m", "tcp", "-p", port, "-1", "-o", "9", *shlex.split(theirs), "127.0.0.1")
            read = run(sys.executable, "-m", "busway", "read", endpoint, *shlex.split(ours), "--json")
            values = [float(found) for found in re.findall(r"^\[\d+\]:\s+(-?[\d.]+)", told, re.MULTILINE)]
            assert values == [float(json.loads(line)["value"]) for line in read.splitlines()], theirs
            assert values, theirs


def run(*words: object) -> str:
    done = subprocess.run(
        [str(word) for word in words],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=foreign.LIMIT, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
