"""Faults of simulated devices, on any transport, switched while everything runs.

==============  =======================================================================
`board`         faults by name: put on, switched, watched
`handler`       a handler around a handler: what a device does wrong with a request
`wires`         what a device does wrong with its bytes and connections
`reading`       ``[[fault]]`` sections and words of the command line → a board
==============  =======================================================================

What goes wrong is known by the personalities of `busway.testing`; that a server plays them is known here.
"""
