"""modbus-connection needs Python 3.12; on 3.11 its tests are not there."""

import sys

collect_ignore = ["test_modbus_connection.py"] if sys.version_info < (3, 12) else []
