"""The gateway: forwards requests from any listener to any upstream (Messaging on TCP/IP V1.0b §4.4.2, "MODBUS/TCP to
serial line gateways").

==================  ===============================================================================================
`address_index`     An index of many address ranges that finds the first one a request touches
`configuration`     Builds a gateway from one file, or from a few URLs
`decoded_reads`     A function table that caches decoded reads, because pollers repeat theirs
`exception_codes`   Chooses the exception code (0A, 0B …) that a client gets for an error of an upstream
`file_routes`       The routes and listeners of a gateway file, each with its path in the file
`forwarding`        Forwarding of requests to an upstream
`gateway`           The gateway: starts, drains, reloads and stops listeners and upstreams
`overview`          The contents of a gateway file as rows of text: listeners, upstreams, and the routing table
`own_unit`          The gateway's own unit: a device with its identification, diagnostics
`policy_gaps`       Finds routes that reach a rule's device by units or addresses that the rule does not name
`read_cache`        Shares and remembers reads of an upstream
`route_checks`      Checks the routes of a gateway file before the gateway runs
`router`            The responder of one listener of a gateway
`routes`            Routes: which upstream and which unit a request is forwarded to
`settings`          The plan of a gateway in memory: its listeners, upstreams and routes, checked
`status`            The status of a gateway: of its listeners, its upstreams, and totals
`translation`       Translates a client's request for its upstream (unit, addresses, size)
`upstream`          An upstream of a gateway: its connections, their loss and recovery, its counters and its status
`upstream_log`      Writes log lines about an upstream: when it cannot be reached
`waiter_deadlines`  Deadlines of clients that wait for a shared read
==================  ===============================================================================================

A gateway is a server whose responder hands each request to a link.
"""
