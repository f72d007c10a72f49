"""Access control of a server: a policy around a handler, and the audit log.

The rules themselves are values (`busway.config.access`).

==============  =======================================================================
`handler`       a handler around a handler that asks a policy
`windows`       the policy compiled into the short road
`entries`       what a line of the audit log says of a request
`audit`         denied requests and writes, as lines of a file
==============  =======================================================================
"""
