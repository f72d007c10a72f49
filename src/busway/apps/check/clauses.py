"""The clauses of the specifications that checks belong to, in a few words each.

Knows names and words only; ``docs/conformance.toml`` has the clauses in full. A test compares the names with it.
"""

from typing import Final

CLAUSES: Final = {
    "A1": "sizes of messages",
    "A2": "function codes",
    "A4": "tables of 65536 items",
    "A7": "order in which a request is judged: function, quantity, address",
    "A9": "reading coils and discrete inputs (01, 02)",
    "A10": "reading registers (03, 04)",
    "A11": "writing a coil (05)",
    "A12": "writing a register (06)",
    "A13": "writing coils (15)",
    "A14": "writing registers (16)",
    "A15": "reading file records (20)",
    "A17": "masking a register (22)",
    "A18": "reading and writing registers (23)",
    "A19": "device identification (43/14)",
    "A21": "every request has an outcome",
    "A22": "status, events, server id and queues (07, 11, 12, 17, 24)",
    "A23": "contents of the event counter and log (11, 12)",
    "M1": "Modbus inside TLS",
    "M2": "versions and suites of TLS",
    "M3": "certificates of both sides",
    "M5": "roles in certificates",
    "M6": "what a role may do",
    "S1": "a server speaks only when it is asked",
    "S2": "one unit, or all of them",
    "S3": "addresses of units",
    "S6": "states of a server: damaged frames are not answered",
    "S8": "RTU frames",
    "S9": "the CRC",
    "S11": "frames for other units",
    "S12": "ASCII frames",
    "S13": "the LRC",
    "S16": "diagnostic counters",
    "S17": "diagnostics (08)",
    "T2": "the MBAP header",
    "T7": "connections stay open",
    "T9": "several transactions at once",
    "T11": "frames in a stream",
    "T12": "several connections",
    "T18": "connections that end half-way",
    "T24": "unit identifiers",
    "T28": "frames that are none",
    "T30": "a reply repeats unit, transaction and protocol",
}
"""What each clause is about, by the name of the clause."""
