"""The Modbus server: devices with their tables and hooks, listeners, and the management of their connections.

Where it is decided: how many connections there may be, also per host, and which is closed for a new one:
`connection_slots`. Which host may connect: `listener_context`. Timeouts of connections: `deadlines`. Requests at once:
`busway.session.transaction_slots`; whose turn it is: `turns`. Graceful stop: `server` (`Server.stop`) and
`connection_management` (`pause_all`, `close_all`). Silence and collisions on a serial line: `line`. Late answers and
failing responders: `responder_failures`. The way of a request, its policy and its audit: `busway.session.pipeline` and
`busway.access`. Rules of unit identifiers: `local`. Memory of a device: `device`, `stores`, `blocks`; its hooks:
`hooks`. Counters and status: `counters`, `status`. Open files of the process: `open_files`.
"""
