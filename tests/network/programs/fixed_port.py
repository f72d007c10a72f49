"""A client that always comes from the same port, as ours never do: told by lines of JSON.

Use: python fixed_port.py HOST PORT OWN_PORT. Questions: ``connect``, ``read``; outcomes: ``value`` or ``error``, and
``seconds``.
"""

import json
import socket
import sys
import time

REQUEST = bytes.fromhex("0001 0000 0006 01 03 0005 0001")
LONGEST = 30.0  # seconds

link = socket.socket()
link.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
link.bind(("", int(sys.argv[3])))
link.settimeout(LONGEST)
print("ready", flush=True)
for line in sys.stdin:
    began = time.monotonic()
    answer: dict[str, object]
    try:
        if json.loads(line)["do"] == "connect":
            link.connect((sys.argv[1], int(sys.argv[2])))
            answer = {"value": None}
        else:
            link.sendall(REQUEST)
            answer = {"value": link.recv(100).hex()}
    except OSError as error:
        answer = {"error": str(error)}
    print(json.dumps({**answer, "seconds": time.monotonic() - began}), flush=True)
