"""Protocol sessions of clients and servers: they decide which request is sent when, and which reply belongs to it.

Sessions do no IO: the caller passes received bytes and the time (``now``), and gets bytes to send and events.

============================  ==========================================================================================
`call`                        Calls of the application, and their requests in flight over TCP, except batches
`call_retries_and_deadlines`  Retries of a link's calls, their deadlines, and the outcome of each request
`client_counters`             The counters of a link: requests, replies, timeouts, retries, late replies, connections
`connection_life`             A client's connection: when to connect, what to report, what becomes of waiting calls
`diagnostic_counters`         What functions 08, 11 and 12 read: counters, event log and listen-only mode of units
`forwarded_reads`             Reads that a gateway forwards on the fast path: those of one TCP segment together
`line_framing`                Framing of a serial session: the receiver, the encoder, and the silence before a frame
`pipelined_batch`             Requests of one call that are sent together over TCP, with their expected replies
`prepared_frame`              The prepared answer to a read in an RTU frame over a network
`queue`                       The bounded queue of one link's calls, and the order in which their requests are sent
`reconnect`                   When a link connects again: the states of its connection, and the pauses between attempts
`responder`                   The interface of responders, which answer the requests of a server
`scan_timeout`                Timeout of a scan for units: as short as the replies so far allow without missing one
`serial_client`               Master of a serial line: one transaction at a time, with turnaround, gaps and late replies
`serial_late_replies`         Late replies on a serial line: which may still come, and which requests must wait for them
`serial_server`               The server's side of a serial line: any number of units, which only answer requests
`server_pipeline`             The way of every request through a server: authorizer, responder and observers
`server_transaction_slots`    The slots that limit how many requests a server works on at once
`tcp_client`                  The client's side of a TCP connection: sends requests of calls and matches replies to them
`tcp_server`                  The server's side of one TCP connection: request bytes in, reply bytes out, without IO
`unit_breaker`                Circuit breakers, one for each unit of a link
============================  ==========================================================================================

Where it is decided: whether a read or a write is sent again (``retries``, ``write_retries``; why a write was sent
twice), when the outcome of a write is unknown, and what a deadline ends in the queue: `call_retries_and_deadlines`; in
flight: `tcp_client` and `serial_client`. A ``timeout`` counts from the sending of the request: `tcp_client` and
`serial_client`; a ``deadline`` counts the time in the queue, too: `call`. Order and limit of waiting requests
(``queue``): `queue`. How many requests are in flight over TCP (``max_transactions``), and which are sent together:
`tcp_client`; when the replies of a batch are taken together: `pipelined_batch`. When to reconnect, and the backoff
(``reconnect_first``, ``reconnect_most``): `reconnect`; what becomes of waiting calls then, and when an unused
connection is closed (``hold``): `connection_life`. When an open connection is given up after timeouts
(``recycle_after_timeouts``) or foreign frames (``recycle_after_foreign``): `tcp_client`; after timeouts with RTU or
ASCII framing over a network: `serial_client`. Units that do not answer (``open_after``): `unit_breaker`, off by default
in collectors, which have `busway.apps.collector.silent_devices`. Late replies: `serial_late_replies` on serial lines,
`tcp_client` on TCP (by transaction identifier). Which replies are accepted in spite of a wrong transaction identifier
or unit (``transaction_policy``, ``unit_policy``): `tcp_client`. Gaps, turnaround and drain of a serial line
(``request_gap``, ``unit_switch_gap``, ``turnaround_delay``, ``quiet_window``, ``drain_limit``), and whether a frame is
the awaited reply, a late or an early one (``early_replies``): `serial_client`. The server's way of a request, with
policy, audit and other observers: `server_pipeline`; its frames: `tcp_server` on TCP, `serial_server` on lines;
exception 06 above ``max_transactions``: `server_transaction_slots`. Reads that a gateway forwards in one step:
`forwarded_reads`. Functions 08, 11 and 12, and when a unit enters and leaves listen-only mode: `diagnostic_counters`;
that a unit in this mode does not answer: `server_pipeline` and `serial_server`. What is counted of a link:
`client_counters`.
"""
