"""Transports: bytes in and out over sockets, serial ports and pairs in memory. Knows no Modbus.

====================  =================================================================================================
`accepting`           Acceptors accept connections from a listening socket
`buffers`             The one receive buffer that all connections of an event loop share
`descriptors`         Reserve of file descriptors: the last ones of the process are kept for Modbus connections
`dialling`            Outgoing TCP connections, from a chosen local address or interface
`interfaces`          The network interfaces of this host: names, addresses, netmasks and gateways
`listening_sockets`   Creates bound sockets to listen on, one for each address, on a named interface if one is given
`opened_connections`  Counts the connections that this process has opened as a client, for the status of a server in it
`tcp`                 TCP sockets: sets their options, and explains their errors
`udp`                 UDP sockets of clients: datagrams in and out, under asyncio and blocking
`epoll`               One epoll object for all connections of an event loop
`serial`              Serial ports: bytes in, bytes out, over a UART
`tls`                 TLS: contexts, certificates, roles of clients, handshakes, and the reasons for which they fail
====================  =================================================================================================
"""
