"""`busway serve`: a server put together from one file, and what stands around it while it runs.

===============  ==========================================================================
`configuration`  `load_configuration`, and the object that holds every parameter (clause T33)
`effective`      every value that holds, as a file
`overview`       what a configuration says, in lines for people
`service`        a server with policy, audit log, metrics and control socket, and how its files are read again
===============  ==========================================================================
"""
