"""Commands: values that people and programs write to points of a running collector, each at most once.

=============  =======================================================================================
`command`      a command, its result, and what it may look like
`point_write`  the request that writes a value to a point, and whether it was written
`journal`      the file that keeps commands and results: recorded before the wire
`runner`       checks, records, sends and confirms commands
`audit`        lines of the audit log for commands and changes of the configuration
`targets`      the points of a running collector as targets of commands, and what they are known to be
=============  =======================================================================================
"""
