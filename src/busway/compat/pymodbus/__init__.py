"""The interface of pymodbus on busway's clients and servers.

============  ======================================================================================================
`aliases`     The names of pymodbus' modules in all its releases, and which module here has what each of them had
`calls`       The calls that all clients share, and the conversion of registers
`client`      The eight clients, each a link of busway
`constants`   The constants of pymodbus that programs name
`datastore`   The data blocks and contexts that programs fill, share, subclass and change while a server runs
`device`      What a server says of itself: the identification objects by number and by name
`exceptions`  The exceptions, and which of them stands for which error of busway
`framer`      The framer types, each the name of a framing
`payload`     The payload builder and decoder
`pdu`         The request and response objects, and the messages of busway that they mean
`server`      The servers, each a server of busway whose responder asks the contexts for values
============  ======================================================================================================

Use it by ``from busway.compat.pymodbus.client import ModbusTcpClient``; or by ``busway.compat.install("pymodbus")``,
called before a library that imports pymodbus is imported.

Where it is decided: what an error of busway becomes: `exceptions` and `client`. Which message a request means: `pdu`.
Which module a program gets for a name: `aliases`. What a request reads and writes in a context: `server`.
"""

from .aliases import HERE, serve_below
from .device import ModbusDeviceIdentification
from .exceptions import ModbusException
from .framer import FramerType
from .pdu import ExceptionResponse

__version__ = "3.16.1"
"""The release of pymodbus whose behaviour these modules have; names of older releases are there too."""

__all__ = [
    "ExceptionResponse",
    "FramerType",
    "ModbusDeviceIdentification",
    "ModbusException",
    "__version__",
    "pymodbus_apply_logging_config",
]


def pymodbus_apply_logging_config(level: str | int = "DEBUG", log_file_name: str | None = None) -> None:
    """Do nothing: the loggers of busway follow the logging configuration of the program."""


def serve_as(name: str) -> None:
    """Make imports below ``name`` find the modules of this package: with ``pymodbus``, ``import pymodbus.client``."""
    serve_below(name)


serve_below(HERE)
