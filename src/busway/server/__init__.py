"""The Modbus server: devices with their tables and hooks, listeners, and the management of their connections.

=======================  ===============================================================================================
`blocks`                 Runs: the memory of a device's tables, as items at consecutive addresses in wire order
`bound_sockets`          The bound sockets of a listener, their URLs, and whether other hosts can reach them
`cells`                  Reads a user's declaration of the items of a table or file
`connection`             The asyncio driver of one accepted connection
`connection_management`  Connection management of a listener: admits, limits and closes connections
`connection_slots`       Connection slots in two pools: which new connection gets one, and which is closed for it
`connection_tap`         Lets a simulated device send bytes of its own on the connections of a server
`counters`               The counters of a server: connections, requests, refusals and bytes
`deadlines`              Timeouts of a listener's connections: which are overdue, and when to check again
`device`                 A Modbus device: its tables, files, queues and identification, and the hooks of its application
`exposure`               Warnings for listeners reachable from the network
`groups`                 Groups of changes that an application makes to a device and that become visible together
`hooks`                  Hooks: functions of the application that a device calls when Modbus reads or writes its tables
`identity`               Identification data of a device: the replies to functions 07, 17 and 43/14
`items`                  Converts items of a table between wire order and the numbers and states that applications and
`line`                   A serial port as a listener: the asyncio driver between a port and the session of its line
`listener`               A listener as it is declared: an endpoint to listen on, with options that hold for it alone
`listener_context`       What all connections of a network listener, TCP or UDP, share
`listener_settings`      Settings of a listener read from its URL, for each scheme
`local`                  The responder of a server with devices in its own process
`loops`                  Runs programs that this library starts itself on an event loop
`open_files`             The system's limit of open files: one connection needs one, and the soft limit is often 1024
`opening`                Opens the listeners of a server, each by its kind: TCP and TLS, UDP, serial
`option_types`           The options of `busway.serve`, for type checkers
`peers`                  Names of peers from socket addresses
`records`                Files of records and queues of registers
`responder_failures`     Awaits responders that need time, and logs and answers for responders that raise an exception
`rtu_over_tcp`           Server sessions with RTU or ASCII frames over TCP or UDP
`server`                 The server: listeners with one pipeline for requests; start, stop, reset, status
`server_options`         Applies the preset of a server to its options and listeners
`serving`                `serve`, `serve_forever`, `serve_in_thread`: a server in a coroutine, a program or a thread
`single_block`           A device with one block of memory: bit functions and word functions reach the same registers
`standard_port`          Adds a listener on the standard port 502 beside those on other ports
`status`                 Servers, listeners and connections as a status shows them. Times are seconds
`status_indicators`      The three status indicators of a listener: communication, error, device status
`stores`                 The memory of one table of a device: its runs, found by address
`tcp`                    A TCP or TLS listener: its listening sockets and the connections they accept
`tls_acceptor`           The TLS handshake acceptor of a secure listener
`turns`                  Turns of connections on an event loop: none works longer than its share while others wait
`typed`                  Typed values, such as `float32`, in the tables of a device, by their written address
`udp`                    A UDP listener: one frame per datagram; each reply goes to the sender of its request
`views`                  The application's view of a table or file: items by address, usable from any thread
=======================  ===============================================================================================

Where it is decided: how many connections there may be, also per host, and which is closed for a new one:
`connection_slots`. Which host may connect: `listener_context`. Timeouts of connections: `deadlines`. Requests at once:
`busway.session.transaction_slots`; whose turn it is: `turns`. Graceful stop: `server` (`Server.stop`) and
`connection_management` (`pause_all`, `close_all`). Silence and collisions on a serial line: `line`. Late answers and
failing responders: `responder_failures`. The way of a request, its policy and its audit: `busway.session.pipeline` and
`busway.access`. Rules of unit identifiers: `local`. Memory of a device: `device`, `stores`, `blocks`; its hooks:
`hooks`. Counters and status: `counters`, `status`. Open files of the process: `open_files`.
"""
