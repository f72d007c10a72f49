"""Transports: bytes in and out over sockets, serial ports and pairs in memory. Knows no Modbus.

====================  ==================================================================================================
`accepting`           Acceptors take new connections from a listening socket: through an `EpollSet` or the event loop
`connection_counter`  Counts the connections that this process has opened as a client, for the status of a server in it
`descriptors`         Reserve of file descriptors: the last ones are kept for Modbus connections
`dialling`            Outgoing TCP connections, from a chosen local address or interface
`listening_sockets`   Creates bound sockets for listeners, one for each address
`local_end`           Explains why a connection or listener could not use the interface or address of an option
`network_interfaces`  The network interfaces of this host: names, addresses, netmasks and gateways
`receive_buffer`      The one receive buffer that all connections of an event loop share
`tcp`                 Sets the options of TCP sockets, and explains their errors
`udp`                 UDP sockets of clients, for asyncio and for blocking links
`epoll`               One epoll object for all connections of an event loop, to save CPU
`serial`              Serial ports: bytes in, bytes out, over a UART, a USB adapter or a pseudo-terminal
`tls`                 TLS: contexts, certificates, roles of clients, handshakes, and the reasons for which they fail
====================  ==================================================================================================

Where it is decided: which local and remote address a connection uses (``local_address``, ``interface``): `dialling`;
why it cannot use them: `local_end`. On which addresses a listener listens: `listening_sockets`. Which socket options
are set (``keepalive``, ``no_delay``, ``user_timeout``): `tcp`. How many connections are accepted at once: `accepting`.
Which descriptors are kept for Modbus: `descriptors`.
"""
