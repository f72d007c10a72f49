"""A server made of busway itself, for the page that sets it beside the others. Prints ``ready PORT``."""

import sys

import busway

ITEMS = 1000

device = busway.Device(coils=ITEMS, discrete_inputs=ITEMS, holding_registers=ITEMS, input_registers=ITEMS)
with busway.serve_in_thread(f"tcp://127.0.0.1:{sys.argv[1]}", units={1: device}) as server:
    print("ready", server.endpoints[0].rpartition(":")[2], flush=True)
    sys.stdin.read()
