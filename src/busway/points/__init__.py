"""Points: the named values of a device, their decoding, and the quality of their values.

==============  =======================================================================
`point`         one point: where it stands, its type, its value: `Point`
`conversion`    raw number ⇄ value in the unit of measure
`decoder`       the reply of a read → the values of all its points: `ReadDecoder`
`derived`       totals of counters, computed points
`quality`       good, uncertain, bad, and the reasons
`expression`    expressions over points, in files
`point_rules`   how units are read; what is written, reported, alarmed
==============  =======================================================================
"""

from .conversion import Conversion, Linear
from .decoder import DecodedRead, ReadDecoder, decode_point
from .derived import Accumulator, Derivation
from .point import Point
from .point_rules import AlarmRule, ItemRange, ReadRules, ReportRule, WriteRule
from .quality import Quality, Reading, Reason

__all__ = [
    "Accumulator",
    "AlarmRule",
    "Conversion",
    "DecodedRead",
    "Derivation",
    "ItemRange",
    "Linear",
    "Point",
    "Quality",
    "ReadDecoder",
    "ReadRules",
    "Reading",
    "Reason",
    "ReportRule",
    "WriteRule",
    "decode_point",
]
