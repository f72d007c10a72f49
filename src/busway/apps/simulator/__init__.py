"""The simulator: devices whose values change by themselves, built from files, and the plant of the demonstration.

==============  =======================================================================
`build`         device files → devices
`points`        the named points of a device: values in their unit of measure
`plant`         a small plant as a function of time
`simulation`    units that behave as a file says: `Simulation`
`includes`      a simulation file and those it includes → one declaration
`builder`       a declaration → devices, points, and what each point follows
`behaviours`    what makes values change
`engine`        which points change when, and into what
`simulated`     a point that behaves, its unit, a change
`registers`     where a point stands in memory, and how numbers become bytes there
`writes`        what Modbus writes to points
`state`         values over a restart
`faults`        what goes wrong on purpose
==============  =======================================================================
"""
