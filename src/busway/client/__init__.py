"""The Modbus client: links, the pools that share them, and the asynchronous and the blocking interface.

=====================  =============================================================================================
`aio`                  The asynchronous interface: links and units for asyncio programs
`blocking`             The blocking interface: links and units for plain programs and threads
`blocking_connection`  One open connection of a blocking link
`blocking_link`        The blocking driver of a link: one client session, one socket, any number of threads
`blocking_pool`        Blocking links by endpoint: one shared connection for all users in a process
`channel`              Interfaces between a link and its connection: asyncio transports and non-blocking channels
`checks`               Checks shared by the asyncio and the blocking interface
`connection_choice`    Explicit connection management: the limit of connections per endpoint
`connector`            Connectors open the connections of a link over the transport that its endpoint names
`kept_late_replies`    Replies still outstanding when a serial link was closed
`link`                 The asyncio driver of a link: one client session and its current connection, on an event loop
`operations`           The operations of a unit, such as reading values, as generators of requests and replies
`option_types`         The options of `busway.connect` and `busway.open`, for type checkers
`polling`              Waits of a blocking link at its socket or serial port, until it is readable or a time is over
`pool`                 Links by endpoint: one shared connection for all users on an event loop
`read_many`            Reads values from several addresses with as few requests as their addresses allow
`registry`             Registry of the client connections of this process: their status and their limit
`scanning`             Finding the units that answer on a line, or behind an address
`scope`                One limit of requests in flight for all links of a client
`serial_connector`     A serial port as the connection of a link, with the methods of a stream
`sessions`             The interface of client sessions that link drivers use
`settings`             The settings of a link: a URL with its options, and keywords, as checked parameter objects
`tls_connector`        Connections of asyncio and blocking links over TLS (MODBUS/TCP Security, port 802)
`shared_links`         The users of links by endpoint: who shares a link, how many there are
=====================  =============================================================================================

Where it is decided: how a large read is split: `operations`. Many reads in one call: `read_many`. Who shares a link:
`registry`. How it is opened: `connector`, `serial_connector`, `tls_connector`. Late replies beyond the end of a link:
`kept_late_replies`. Retries, unknown outcomes of writes and reconnecting: `busway.session`.
"""
