"""busway without sockets: fixed scripts of transactions whose work can be counted, or timed, without the kernel.

==============  =================================================================================================
`wire`          an event loop on which listeners and connections are objects in memory
`scripts`       what is done: a server asked, a client asking, a gateway between them, in fixed bytes
`counting`      calls, instructions and memory of a script, the same on every machine
`layers`        which layer of the house a module belongs to
`guard`         as a program: counts all scripts and prints JSON
`growth`        as a program: times a transaction against connections, units, table sizes and routes
`growth_of_points`  part of it: a polled value, a planned point, a sample of a message, by how many there are
`codecs`        as a program: times every message, numbers, CRC and LRC
==============  =================================================================================================
"""
