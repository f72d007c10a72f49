"""Behaviours, which make simulated values change: each is a function of the simulation's time and its own state.

Knows time as a number; knows no clock, no device and no register. The keys in files are known by
`busway.config.files.behaviours`.

==============  =====================================================================
`behaviour`     what the engine asks of each of them
`waves`         those that depend on time alone: constant, ramp, sine, square
`chance`        noise and random walk, the same for the same seed
`sums`          those that go on from their last value: counter and lag
`formula`       a value that is an expression
`replay`        recorded values
`builder`       a section of a file → its behaviour
==============  =====================================================================
"""
