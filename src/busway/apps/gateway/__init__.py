"""The gateway: forwards requests from any listener to any upstream (Messaging on TCP/IP V1.0b §4.4.2, "MODBUS/TCP to
serial line gateways").

==========================  ============================================================================================
`address_index`             An index of many address ranges: finds the first one that a request touches
`batch`                     Requests of one client that go upstream together, and all clients that wait for them
`configuration`             Reads the configuration of a gateway from one file, or from a few URLs
`decoded_reads`             A table of functions that caches decoded reads, because clients repeat theirs
`file_routes`               The routes and listeners of a gateway file, each with its path in the file
`forwarding`                Sends batches upstream, and gives each client its reply or exception code
`gateway`                   The gateway: starts, drains, reloads and stops listeners and upstreams
`gateway_plan`              What a gateway is made of, as checked objects: listeners, upstreams and routes
`overview`                  The contents of a gateway file as rows of text: listeners, upstreams, routes
`own_unit`                  The gateway's own unit: its identification, diagnostics and status registers
`policy_gaps`               Finds routes that reach a rule's device by units or addresses that the rule does not name
`read_cache`                Values read recently, until they are too old or a write comes; when reads may not be shared
`shared_read_deadlines`     Deadlines of clients that share a read: each has its own; the read goes on for the others
`shared_reads`              Two clients that read the same at once: the second gets the reply to the first one's read
`route_checks`              Checks the routes of a gateway file before the gateway runs
`router`                    Which upstream or own unit answers a request of one listener; broadcasts
`routes`                    Routes: which upstream and which unit a request is forwarded to
`status`                    Data classes for the status of a gateway: its listeners, its upstreams, and totals
`translation`               Translates a client's request for its upstream (unit, addresses, size)
`upstream_exception_codes`  Exception code (0A or 0B) for the client when an upstream is down, silent or dies
`upstream`                  One upstream: its connections, their loss and recovery, counters and status
`upstream_log`              Log lines about an upstream: when it cannot be reached, how many requests got 0A
==========================  ============================================================================================

A gateway is a server whose responder hands each request to a link.

Where it is decided: which upstream and unit get a request, and which requests are refused or dropped (``unit_offset``,
``refuse``, ``drop``): `routes`. What is changed in it (``shift``, ``max_registers``, ``split_writes``): `translation`.
0A or 0B when an upstream is down, silent or dies: `upstream_exception_codes`. Which values are still fresh enough to
answer from memory (``cache``), and whether a write forbids to share reads: `read_cache`. Whether the read of a client
joins an equal one in flight or goes upstream itself (a priority host does not wait behind others): `shared_reads`. What
becomes of the requests of a client that has left (a write that was sent goes on): `forwarding`. Whether a request is
sent upstream twice: `busway.session.call_retries_and_deadlines`. Whose request goes next on an upstream, and how many
may wait there (``queue``): `busway.session.queue`; one more gets 0A: `upstream_exception_codes`. 06 comes from the
listener (``max_transactions``): `busway.session.tcp_server`. How long each client waits (``client_deadline``): `batch`
gives its requests the deadline, `busway.session.call_retries_and_deadlines` ends those in the queue, and the session
those in flight; for clients that share a read: `shared_read_deadlines`. Broadcasts (``broadcast``,
``silent_broadcasts``): `router`. What a read of the gateway itself gives (``own_unit``): `own_unit`. Connecting again:
`upstream` and `busway.session.reconnect`. Which sections a reload changes at once:
`busway.apps.service.reloadable_sections`; how: `gateway`. How long requests in flight may take at the end: ``drain`` in
`busway.options.gateway`, kept by `gateway`.
"""
