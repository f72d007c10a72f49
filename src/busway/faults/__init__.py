"""How real devices and clients misbehave, each way under one name: for tests, the simulator and the command line.

==========================  ==========================================================================
`fault`                     what a fault can do to a conversation, when, and how it is switched
`profile`, `profiles`       fault profiles of real devices by name, with parameters and what they are about
`clients`                   clients that misbehave
`conversation`              one connection of a device with faults: requests in, bytes out
`responder`, `connections`  the same around the responder and the connections of a real server
`switchboard`               faults by name: put on, switched, watched
`clock`                     the time they use, real or moved by hand
==========================  ==========================================================================
"""
