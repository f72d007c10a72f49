"""Points: the named values of a device, their decoding, and the quality of their values.

=============  ==================================================================================================
`conversion`   Conversion between the raw number in the registers and the value in the unit of measure
`decoder`      Decodes the reply of a read into the values of all points in it, by one compiled function
`derived`      Values derived from several reads: totals of counters that roll over, and computed points
`expression`   Expressions over points and time, parsed from text and evaluated without executing Python code
`point`        A point: one named value of a device, which others call a tag
`point_rules`  Rules of points: limits for reading a unit, and rules for writing, reporting and alarms of a point
`quality`      Quality of a value (good, uncertain, bad), and the reason if it is not good
=============  ==================================================================================================
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
