"""The Modbus server: devices with their tables and hooks, listeners, and the management of their connections.

=======================  ===============================================================================================
`address_map`            Which addresses of a table or file exist, which are read-only, and the memory run of each
`bound_sockets`          The bound sockets of a listener, their URLs, and whether other hosts can reach them
`change_groups`          Groups of changes that an application makes to a device and that become visible together
`connection`             The asyncio driver of one accepted connection
`connection_management`  Connection management of a TCP or TLS listener: admits, limits and closes connections
`connection_slots`       Connection slots in two pools: which new connection gets one, and which is closed for it
`connection_tap`         Lets a simulated device send bytes of its own on the connections of a server
`deadlines`              Timeouts of a listener's connections: which connections are overdue, and when to check again
`device`                 A Modbus device: its tables, files, queues and identification, and the hooks of its application
`device_responder`       The responder of a server with devices in its own process: finds the device of the unit
`exposure`               Warnings in the log for listeners that other hosts can reach
`file_records`           Files of records, and queues of registers
`hooks`                  Hooks: functions of the application that a device calls when Modbus reads or writes its tables
`identity`               Checks of a device's identification: what functions 07, 17 and 43/14 answer
`item_conversion`        Converts items of a table between wire order and the values that applications see
`listener`               A listener as it is declared: an endpoint to listen on, with options that hold for it alone
`listener_context`       What all connections of a network listener, TCP or UDP, share: access list, sessions
`listener_settings`      Settings of a listener, read from its URL, whichever scheme it has
`loops`                  Runs the event loops that this library starts itself: uvloop's if it is installed
`memory_runs`            Raw memory of tables: runs of registers or bits at consecutive addresses, in wire order
`open_files`             The system's limit of open files, which limits connections: each needs one
`opening`                Opens the listeners of a server, each by its kind: TCP and TLS, UDP, serial
`option_types`           The options of `busway.serve`, for type checkers
`responder_failures`     Handles responders that need time or raise an exception: awaits them, logs
`serial_listener`        A serial port as a listener: the asyncio driver between a port and the session of its line
`serial_over_network`    Server sessions for RTU or ASCII frames over TCP or UDP
`server`                 The server: listeners with one pipeline for requests; start, stop, reset, status
`server_counters`        The counters of a server: connections, requests, refusals and bytes
`server_options`         Applies the preset of a server, such as `strict`, to its options and listeners
`serving`                Functions that run a server: `serve` in a coroutine, `serve_forever` in a blocking program
`single_block`           A device with one block of memory: bit functions and word functions reach the same registers
`standard_port`          Adds a listener on the standard port 502 beside those on other ports
`status`                 The status of a server: data classes for the server, its listeners and connections
`status_indicators`      The three status indicators of a listener (communication, error, device)
`table_declaration`      Checks how a user declared a table or file: addresses, initial values, read-only ranges
`table_view`             The application's view of a table or file: items by address, usable from any thread
`tcp`                    A TCP or TLS listener: its listening sockets and the connections they accept
`tls_admission`          Admits clients of a TLS listener: runs the handshakes and checks host, certificate and role
`turns`                  Turns: connections that share an event loop get it in turn
`typed`                  Reads and writes of typed values, such as `float32`
`udp`                    A UDP listener: one frame per datagram; each reply goes to the sender of its request
=======================  ===============================================================================================

Where it is decided: how many connections there may be, also per host, and which is closed for a new one
(``max_connections``, ``max_per_host``, ``priority``): `connection_slots`. Which host may connect (``allow``, ``deny``):
`listener_context`; which TLS client (certificate, ``require_purpose``, ``require_role``), and how many handshakes go on
at once: `tls_admission`. After which timeout a connection is closed (``idle_timeout``, ``header_timeout``,
``frame_timeout``, ``write_timeout``): `deadlines`. When nothing more is read from a client, because it reads no replies
(``write_buffer``) or its host is above ``request_rate``: `connection`. Requests at once (``max_transactions``,
exception 06): `busway.session.tcp_server`; whose turn it is: `turns`. Graceful stop: `server` (`Server.stop`) and
`connection_management` (``pause_all``, ``close_all``). When a reply leaves on a serial line (``precise_timing``), and
that it is dropped if another station sends first: `serial_listener`. Late answers and failing responders (exception
04): `responder_failures`. The way of a request, its policy and its audit: `busway.session.server_pipeline` and
`busway.access`. Rules of unit identifiers (``unit_policy``), and exceptions 0B (``unlisted``) and 01 of unlisted units
and functions: `device_responder`. Exception 02: `address_map` for tables, `device` for queues, `file_records` for
files; a request checks all its items first (`Device.check`), and nothing is written then. Which addresses exist, and
which are read-only: `address_map`, from what `table_declaration` accepted. Which devices have one memory for several
tables: `single_block`. What other clients see of a change of several values: `change_groups`. The bytes themselves:
`memory_runs`. When hooks are called, and what they may refuse: `device`, `hooks`. Counters and status:
`server_counters`, `status`. Open files of the process: `open_files`. What is logged of listeners that other hosts can
reach: `exposure`.
"""
