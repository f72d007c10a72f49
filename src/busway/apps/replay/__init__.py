"""`busway replay`: the Modbus traffic of a capture file, what was wrong in it, and a simulation made from it.

==================  ================================================================================================
`conversations`     The exchanges between each client and unit of a capture, counted, and what was wrong in them
`exchanges`         Finds the reply to each request of a capture, and what is wrong with the two
`item_ranges`       The items of a table that requests touched, as ranges
`recorded_devices`  What the units of a capture hold and refuse, and the simulation file that answers as they did
==================  ================================================================================================

Where it is decided: which reply answers which request, and what counts as wrong: `exchanges`. What is shown of a
conversation: `conversations`. Which values and exceptions a simulation file has: `recorded_devices`.
"""
