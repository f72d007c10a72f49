"""Access control: which hosts may connect, which requests a policy permits, and the audit log (clauses M6, T15).

==================  =================================================================================================
`addresses`         Address lists: which hosts may connect; allow and deny lists, and secure mode
`audit_line`        One line of the audit log: a request and its outcome as JSON
`audit_log`         The audit log: an append-only file with one JSON object per line
`audit_observer`    The observer that records writes and denied requests in the audit log
`authorizer`        The authorizer of a server: decides every request by a policy
`denials`           Counts repeated denials of one client by one rule
`fast_path_rights`  Fast answers under a policy: limited to the permitted items, and writes with audit lines
`notation`          Units, functions and ranges of items as people write them in rules
`question`          The facts of one request that a policy decides about: client, unit, function, items and values
`rates`             Request rates per host: a token bucket for each host, shared by all its connections
`repeats`           Limiter for repeated log messages: the first is logged at once
`rights`            The rights of clients: the rules of a policy that apply to them, compiled once for fast decisions
`rules`             Rules of a policy in their order: which clients and requests each applies to, and what it does
==================  =================================================================================================
"""
