"""The Modbus client: links, the pools that share them, and the asynchronous and the blocking interface.

==========================  ========================================================================================
`aio`                       The asynchronous interface of the client: links and units for asyncio programs
`assumed_settings`          What links assume where the user gives nothing: a unit number, settings of a serial port
`blocking_connection`       One open connection of a blocking link: its socket or port
`blocking_link`             The blocking driver of a link: one client session, one socket, any number of threads
`blocking_pool`             Blocking links by endpoint: one shared connection for all users in a process
`blocking`                  The blocking interface: links and units for plain programs and threads
`channel`                   Interfaces between the driver of a link and its connection
`connection_choice`         Explicit connection management: connections per endpoint, links with ``select``
`connector`                 Objects that open the connections of a link over the transport that its endpoint names
`kept_serial_late_replies`  Late replies still to come when a serial link is closed, kept for the next link
`link`                      The asyncio driver of a link: one client session and its current connection
`open_connections`          The client connections of this process: shows their status and limits their number
`operations`                Operations of a unit, such as reading values, as generators of requests, without IO
`option_types`              The options of `busway.connect` and `busway.open`, for type checkers
`permitted_sending`         Connections that send only while a function permits it
`pool`                      The links of an event loop: one shared connection for all users of an endpoint
`read_many`                 Reads values from several addresses with as few requests as possible
`readiness`                 Waits of a blocking link at its socket or serial port
`refused_calls`             Errors of calls that a link refuses before anything is sent
`scanning`                  Finding the units that answer on a line, or behind an address
`serial_connector`          The connector for serial ports: opens a port for a link, waits for a missing one
`sessions`                  The interface of client sessions that link drivers use
`settings`                  The settings of a link, read from its URL and from keywords, as checked objects
`shared_limit`              One limit of requests in flight for all links of a client
`shared_links`              Links by endpoint: who shares one, how many there are, and which link a request takes
`shown_state`               The words for the states of a connection in the ``repr`` of a link
`state_observers`           Callbacks of a program for changes of a connection's state
`tls_connector`             The connector for TLS: opens connections of asyncio and blocking links
==========================  ========================================================================================

Where it is decided: how a large read is split: `operations`. Many reads in one call: `read_many`. Who shares a link
(``shared``), and why a second one with other settings is refused: `shared_links`. How many connections this process may
have: `open_connections`; to one endpoint (``max_connections``): `connection_choice`; how many a server accepts:
`busway.server.connection_slots`. How one is opened (``connect_timeout``, ``local_address``, ``interface``):
`connector`, `tls_connector`; how long a missing serial port is waited for (``port_wait``): `serial_connector`. Which
unit number and serial settings hold where none are given, and the hint of it in errors: `assumed_settings`. Requests in
flight of all links of a client (``scope=client``): `shared_limit`. Which units a scan finds: `scanning`; how long it
waits for each: `busway.session.scan_timeout`. Whether a frame may still leave, in a fleet: `permitted_sending`. Late
replies beyond the end of a serial link (why a program that opens a link for each reading gets no wrong value):
`kept_serial_late_replies`. How exactly a frame is sent on time (``precise_timing``): `link`, `blocking_link`. Retries,
writes that are sent twice, unknown outcomes of writes and reconnecting: `busway.session`.
"""
