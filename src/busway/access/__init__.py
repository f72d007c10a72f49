"""Access control: which hosts may connect, which requests a policy permits, and the audit log (clauses M6, T15).

===============================  ==========================================================================
`networks`, `addresses`          lists of addresses; who may connect at all
`notation`, `question`, `rules`  rules as people write them, the facts of one request, and the decision. Pure.
`rates`, `repeats`               how often something may be asked, and how often it is told
`authorizer`                     asks the rules about every request of a server
`decisions`, `compiled`          what is remembered of decisions, and the rules compiled into the fast path
`writes`                         writes on the fast path: limits, and lines of the log
`audit`, `entries`, `denials`    the audit log: the file, its lines, and repeated denials
===============================  ==========================================================================
"""
