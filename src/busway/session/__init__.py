"""Protocol sessions of clients and servers: which request is sent when, and which reply belongs to it. Pure: bytes and
``now`` in, bytes and events out.

Where it is decided: whether a read or a write is repeated, and when its outcome is unknown: `retries`. Order and limit
of waiting requests: `queue`. When to reconnect, and the backoff: `reconnect`; what becomes of open requests then:
`connection_life`. Units that do not answer: `unit_breaker`. Late replies: `late_replies` on serial lines, `client` on
TCP (by transaction identifier). Gaps, turnaround and drain of a serial line: `serial_client`. The server's way of a
request, with policy, audit and other observers: `pipeline`; its frames: `server` on TCP, `serial_server` on lines.
Reads that a gateway forwards in one step: `forwarded_reads`. Functions 08, 11 and 12: `diagnostics`.
"""
