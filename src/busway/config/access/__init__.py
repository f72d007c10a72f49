"""Access rules as values: who may connect, and who may ask what. Pure: no socket, no clock, no file.

==============  =======================================================================
`networks`      lists of IPv4 and IPv6 addresses and networks
`addresses`     who may connect at all: allow and deny lists, secure mode
`notation`      units, functions and ranges of items as people write them
`question`      what a policy is asked: the facts of one request
`rules`         rules in their order, and their decision
==============  =======================================================================

`busway.server.policy` puts them around a handler, and writes the audit log.
"""
