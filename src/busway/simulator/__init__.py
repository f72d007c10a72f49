"""Devices that behave: built from files, and the plant of the demonstration.

==============  =======================================================================
`build`         device files → devices
`points`        the named points of a device: values in their unit of measure
`plant`         a small plant as a function of time
==============  =======================================================================
"""
