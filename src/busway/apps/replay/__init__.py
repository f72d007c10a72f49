"""`busway replay`: what was said in a capture file, what was wrong in it, and a simulator that answers as it did.

==================  ================================================================================================
`conversations`     What a client and a unit said to each other in a capture, counted, and what was wrong
`exchanges`         Finds the reply to each request of a capture, and what is wrong with the two
`item_ranges`       The items of a table that requests touched, as ranges
`recorded_devices`  What the units of a capture hold and refuse, and the simulator file that answers as they did
==================  ================================================================================================

Where it is decided: which reply answers which request, and what counts as wrong: `exchanges`. What is shown of a
conversation: `conversations`. Which values and exceptions a simulator file has: `recorded_devices`.
"""
