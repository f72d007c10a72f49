"""What makes values change: each behaviour is a function of the simulation's time, and of a state of its own.

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
