"""Behaviours, which make simulated values change: each is a function of the simulation's time and its own state.

===========  ===========================================================================
`behaviour`  The interface of behaviours, as the engine of a simulation uses it
`builder`    Builds behaviours from the sections of a simulation file
`chance`     Random behaviours, equal for equal seeds: noise and random walk
`formula`    Behaviour `formula`: a value computed from other points and the time
`replay`     Behaviour `replay`: recorded values from lines `time,value`
`sums`       Behaviours that continue from their last value: counter and first-order lag
`waves`      Behaviours that depend on time alone: constant, ramp, sine, square
===========  ===========================================================================

Knows time as a number; knows no clock, no device and no register. The keys in files are known by
`busway.config.files.behaviours`.

Where it is decided: which behaviour a section declares: `builder`. Which methods the engine calls, and at which times:
`behaviour`. Which random numbers a seed gives (``seed``): `chance`. What comes at the end (``at_end``): `waves`,
`replay`; when a counter begins again (``rollover``): `sums`.
"""
