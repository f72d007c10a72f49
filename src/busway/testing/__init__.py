"""Test helpers: a server with faults, connections in memory, a clock moved by hand, known devices and frames.

==============  ====================================================================================================
`certificates`  Certificates for tests: valid ones, and one of each kind that a peer must refuse
`device`        A test device whose every value follows from its address, so that tests know it without reading
`golden`        Golden frames: requests and replies whose right bytes are known from the specification
`line`          A serial bus in real time, over pseudo-terminals: programs open its ports as they open real ones
`memory`        Connections in memory: a pair of asyncio transports, where each gets what the other sends
`plugin`        The pytest plugin of busway: simulated devices, serial lines and a clock as fixtures
`server`        A Modbus TCP server with faults, for tests of clients: the real server with a real device
`simulated`     A simulated device for tests: values or a file, served in a thread of its own
`virtual_line`  A simulated serial bus without real time: ports, characters with durations, collisions and cut wires
==============  ====================================================================================================

Public, also for tests of programs that use the library. The module of a name is imported at its first use.

Where it is decided: when a byte is on the bus, and what a collision does: `virtual_line` (simulated time), `line` (real
time). What the test device answers: `device`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..faults.applied_faults import AppliedFault, Faults, Schedule, Selection
    from ..faults.clients import CLIENT_FAULT_PROFILES, SLOW_LORIS, ClientFaultProfile, misbehaving_client
    from ..faults.clock import Clock, FakeClock, LoopClock
    from ..faults.fault import SILENCE, Contact, Emission, Exchange, Fault
    from ..faults.faulty_conversation import FaultyConversation
    from ..faults.profile import Carrier, FaultProfile, FaultProfileTable
    from ..faults.profiles import FAULT_PROFILES
    from .certificates import CertificateFiles, CertificateStore
    from .device import known_device
    from .golden import GOLDEN_EXCEPTIONS, GOLDEN_EXCHANGES, GoldenExchange, golden_adu
    from .memory import MemoryPair, MemoryTransport, Passage
    from .server import FaultyServer, faulty_server
    from .simulated import SimulatedDevice, simulated_device

_HOME = {
    "certificates": ("CertificateFiles", "CertificateStore"),
    ".faults.clients": ("CLIENT_FAULT_PROFILES", "SLOW_LORIS", "ClientFaultProfile", "misbehaving_client"),
    ".faults.clock": ("Clock", "FakeClock", "LoopClock"),
    ".faults.faulty_conversation": ("FaultyConversation",),
    "device": ("known_device",),
    ".faults.applied_faults": ("AppliedFault", "Faults", "Schedule", "Selection"),
    ".faults.fault": ("SILENCE", "Contact", "Emission", "Exchange", "Fault"),
    "golden": ("GOLDEN_EXCEPTIONS", "GOLDEN_EXCHANGES", "GoldenExchange", "golden_adu"),
    "memory": ("MemoryPair", "MemoryTransport", "Passage"),
    ".faults.profiles": ("FAULT_PROFILES",),
    ".faults.profile": ("Carrier", "FaultProfile", "FaultProfileTable"),
    "server": ("FaultyServer", "faulty_server"),
    "simulated": ("SimulatedDevice", "simulated_device"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "CLIENT_FAULT_PROFILES",
    "FAULT_PROFILES",
    "GOLDEN_EXCEPTIONS",
    "GOLDEN_EXCHANGES",
    "SILENCE",
    "SLOW_LORIS",
    "AppliedFault",
    "Carrier",
    "CertificateFiles",
    "CertificateStore",
    "ClientFaultProfile",
    "Clock",
    "Contact",
    "Emission",
    "Exchange",
    "FakeClock",
    "Fault",
    "FaultProfile",
    "FaultProfileTable",
    "Faults",
    "FaultyConversation",
    "FaultyServer",
    "GoldenExchange",
    "LoopClock",
    "MemoryPair",
    "MemoryTransport",
    "Passage",
    "Schedule",
    "Selection",
    "SimulatedDevice",
    "faulty_server",
    "golden_adu",
    "known_device",
    "misbehaving_client",
    "simulated_device",
]


def __getattr__(name: str) -> Any:  # any public name, of any type
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module 'busway.testing' has no attribute {name!r}")
    value = getattr(import_module(f".{module}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
