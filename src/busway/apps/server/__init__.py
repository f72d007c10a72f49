"""`busway serve`: a server put together from one file, and its policy, logs and metrics.

===============  ==========================================================================
`configuration`  `load_configuration`, and the object that holds every parameter (clause T33)
`effective`      every value that holds, as a file
`overview`       what a configuration says, in lines for people
`service`        a server with policy, audit log, metrics and control socket: start, stop, reload
`reload`         what a configuration that is read again declares, and how it differs
`interfaces`     what a service runs, and what declares it
===============  ==========================================================================
"""
