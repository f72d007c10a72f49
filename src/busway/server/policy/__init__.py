"""Access control of a server: a policy around a handler, and the audit log.

The rules themselves are values (`busway.config.access`); `networks`, `addresses` and `rules` here are their names for
servers.

==============  =======================================================================
`handler`       a handler around a handler that asks a policy
`windows`       the policy compiled into the short road
`rates`         requests per second and host
`audit`         denied requests and writes, as lines of a file
==============  =======================================================================
"""
