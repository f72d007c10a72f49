"""Fault profiles of real devices and clients, for tests, the simulator and the command line.

=====================  =================================================================================================
`applied_faults`       The faults of a server: which requests each applies to, when it is active, how often it applied
`clients`              Fault profiles of clients: the bytes that a misbehaving client sends before it falls silent
`clock`                Clocks that time delayed replies: that of an event loop, and one that a test moves
`fault`                A fault: what it changes in the requests and replies of a connection
`faulty_connections`   Carries out faults on a server's connections: sends delayed and changed replies
`faulty_conversation`  One connection of a faulty device, without IO: which bytes answer its requests, and when
`faulty_responder`     A responder that wraps another one and applies faults to its replies
`profile`              The class of fault profiles, and the check of their parameters: refuses unknown ones
`profiles`             The table of all fault profiles of devices; the profiles are defined in the files beside this one
`switchboard`          The faults of a server by name: added, switched and removed while it runs
=====================  =================================================================================================

Where it is decided: whether a fault applies to a request (``units``, ``functions``, ``probability``, ``schedule``):
`applied_faults` (`Faults.strike`). What a fault can change: `fault`. Which bytes are sent in place of the device's, and
when: `faulty_conversation`. Which fault profiles there are, and which parameters each has (a new one is an argument of
its function): `profiles`; which parameters are refused: `profile`. Which faults are on: `switchboard`.
"""
