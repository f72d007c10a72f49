"""Points: the named values of a device, their decoding, and the quality of their values.

===============  =======================================================================================================
`conversion`     Conversion between the raw number in a point's registers and its value in a unit of measure, as kW
`decoder`        Turns the reply to a read request into the values of all points in it, by one compiled function
`derived`        Points computed from others: running totals of counters that roll over, and points with a formula
`expression`     Formulas over points and time: parsed from text, evaluated without executing Python code
`name_patterns`  Patterns of names: which devices and points a pattern such as ``meter-7/*`` means
`point`          A point: one named value of a device, which others call a tag
`point_rules`    Rules that device files give for points: limits of reads, and what may be written
`quality`        The words for quality (good, uncertain, bad) and its reasons; a value gets its reason elsewhere
===============  =======================================================================================================

Where it is decided: the reason why a value is not good: `decoder` for a reply (not a number, out of range, no value),
`derived` for computed points, `busway.apps.collector.poller` for a read without reply and a clock that is not set;
`busway.cli.read_points` where points are read once. Good, uncertain or bad follows from the reason alone: `quality`.
What raw number and unit mean (``scale``, ``offset``, ``linear``): `conversion`; which raw number means no value
(``invalid``, ``valid``): `decoder`. Whether a value may be written: `point_rules`. What a formula may contain:
`expression`. When a counter has rolled over (``rollover``): `derived`. Whether a change of a value is large enough to
be reported (``deadband``, ``max_silence``): `point_rules`.

What describes a point is imported from here; `decoder` and `derived` by those that read.
"""

from .conversion import Conversion, Linear
from .point import Point
from .point_rules import AlarmRule, ItemRange, ReadRules, ReportRule, WriteRule
from .quality import Quality, Reading, Reason

__all__ = [
    "AlarmRule",
    "Conversion",
    "ItemRange",
    "Linear",
    "Point",
    "Quality",
    "ReadRules",
    "Reading",
    "Reason",
    "ReportRule",
    "WriteRule",
]
