"""A unit of a simulation: points of the common types, some with a behaviour, some with a first value only."""

PLANT_UNIT = """\
[[unit]]
unit = 1
name = "plant"

[[unit.point]]
name = "voltage"
address = "3x1"
type = "float32"
unit_of_measure = "V"
description = "Of the grid."
behaviour = { kind = "sine", mean = 230, amplitude = 4, period = 60 }

[[unit.point]]
name = "energy"
address = "4x1"
type = "uint32"
order = "CDAB"
behaviour = { kind = "counter", rate = 2, resume_after = 0 }

[[unit.point]]
name = "level"
address = "4x3"
type = "float32"
minimum = 0
maximum = 4
behaviour = { kind = "ramp", last = 4, duration = 100 }

[[unit.point]]
name = "speed"
address = "4x5"
scale = 0.1
minimum = 0
maximum = 50
behaviour = { kind = "square", high = 10, period = 20, resume_after = 5 }

[[unit.point]]
name = "mode"
address = "4x6"
value = "auto"
enumeration = { off = 0, auto = 1 }

[[unit.point]]
name = "pump"
address = "0x1"
value = true

[[unit.point]]
name = "label"
address = "4x10"
type = "string:4"
value = "abcd"

[[unit.point]]
name = "walk"
address = "3x10"
type = "float32"
value = 50
behaviour = { kind = "random-walk", step = 1 }
"""
