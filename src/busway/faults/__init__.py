"""Fault profiles of real devices and clients, for tests, the simulator and the command line.

==========================  ==========================================================================
`fault`                     what a fault changes, when it is active, and how it is switched
`profile`, `profiles`       fault profiles of real devices by name, with their options
`clients`                   fault profiles of clients
`faulty_conversation`       one connection of a faulty device, without IO: requests in, bytes out
`responder`, `connections`  the same around the responder and the connections of a real server
`switchboard`               the faults of a server by name: added, switched, watched
`clock`                     real and fake clocks for delays
==========================  ==========================================================================
"""
