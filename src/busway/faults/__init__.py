"""Fault profiles of real devices and clients, for tests, the simulator and the command line.

=====================  =================================================================================================
`clients`              Fault profiles of clients: the bytes that a misbehaving client sends before it falls silent
`clock`                Clocks for delays: that of an event loop, and a fake clock that a test moves by hand
`connections`          The connection tap of faults: sends delayed and changed replies on a server's connections
`fault`                Faults: what they change in the requests and replies of a connection, when they are active
`faulty_conversation`  One connection of a faulty device, without IO
`profile`              Fault profiles: named ways in which real devices misbehave, each with its options
`responder`            A responder that wraps another one and applies faults to its replies
`switchboard`          The faults of a server by name: added, switched and removed from a file
`profiles`             The table of all fault profiles of devices; the profiles are defined in the files beside this one
=====================  =================================================================================================
"""
