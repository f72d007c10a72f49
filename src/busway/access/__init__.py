"""Access control: which hosts may connect, which requests a policy permits, and the audit log (clauses M6, T15).

==================  ====================================================================================================
`access_request`    A request as an access policy sees it: client, unit, function, items and values
`addresses`         Address lists: which hosts may connect; allow and deny lists, and secure mode
`audit_line`        One line of the audit log: a request and its outcome as JSON
`audit_log`         The audit log: an append-only file with one JSON object per line
`audit_observer`    The observer of a server's requests that records writes and denied requests in the audit log
`authorizer`        The authorizer of a server: permits or denies every request by the rules of a policy (M6, T15)
`fast_path_rights`  The server's fast path under a policy: checks addresses and values and audits writes
`notation`          Parsers of the units, functions and address ranges that people write in access rules
`rates`             Limits of requests per second by client host: a token bucket for each host
`repeated_denials`  Counts repeated denials of one client by one rule: the audit log gets the first at once
`rule_evaluation`   Which rule decides about a request where several apply (the first), compiled once per rights
`rules`             A rule: which clients and requests it applies to, and what it does; a policy: rules in their order
`unreached_rules`   Finds rules that can never decide, because an earlier rule takes all requests that they apply to
==================  ====================================================================================================

Where it is decided: which of two rules wins: `rule_evaluation` (the first that applies); which rules can never decide:
`unreached_rules`. What a rule applies to: `rules`. Which exception code refuses a request: ``Rule.code`` in `rules` (01
or 02), and 01 by default in `rule_evaluation`; 06 above a rate (``rate``), and 04 if the audit log cannot be written
(``on_failure``): `authorizer`. What holds without a policy (why `busway serve` refuses writes of other hosts):
`busway.apps.service.listeners_without_policy`. From which request on a replaced policy holds: `authorizer`. Which host
may connect: `addresses`; which TLS client, and its role: `busway.server.tls_admission`. Which lines the audit log has:
`audit_observer`, and `fast_path_rights` for writes on the fast path; what they say: `audit_line`; what happens on a
full disk: `audit_log`. How often a repeated denial is logged: `repeated_denials` in the audit log
(``repeat_interval``), `busway.log_limiter` in the log.
"""
