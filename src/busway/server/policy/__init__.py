"""Access control of a server: a policy around a handler, and the audit log.

The rules themselves are values (`busway.config.access`).

==============  =======================================================================
`handler`       a handler around a handler that asks a policy
`decisions`     what the long road remembers of the policy
`windows`       the policy compiled into the short road
`writes`        writes that are looked at there: limits, and lines
`entries`       what a line of the audit log says of a request
`audit`         denied requests and writes, as lines of a file
==============  =======================================================================
"""
