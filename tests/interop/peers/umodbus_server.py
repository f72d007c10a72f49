"""A Modbus server made of uModbus, for the check of peers: ``umodbus_server.py PORT``; port 0 takes a free one.

Prints ``ready PORT``. Four tables of 1000 items with the known content, on every unit.
"""

import logging
import sys
from socketserver import ThreadingTCPServer

from conversation import COILS, DISCRETE_INPUTS, HOLDING_REGISTERS, INPUT_REGISTERS, ITEMS, say
from umodbus.server.tcp import RequestHandler, get_server


class Server(ThreadingTCPServer):
    daemon_threads = True

    def handle_error(self, request, client_address):
        """Say nothing: what a damaged frame does to a connection is seen from outside."""


server = get_server(Server, ("127.0.0.1", int(sys.argv[1])), RequestHandler)
PLACES = range(ITEMS)


def table(reading, writing, items):
    @server.route(function_codes=reading, addresses=PLACES)
    def read(slave_id, function_code, address):
        return int(items[address])

    if writing:

        @server.route(function_codes=writing, addresses=PLACES)
        def write(slave_id, function_code, address, value):
            items[address] = value


table([1], [5, 15], COILS)
table([2], [], DISCRETE_INPUTS)
table([3], [6, 16], HOLDING_REGISTERS)
table([4], [], INPUT_REGISTERS)
logging.disable(logging.CRITICAL)
say(f"ready {server.server_address[1]}")
server.serve_forever()
