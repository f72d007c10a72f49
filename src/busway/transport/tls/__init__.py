"""TLS: contexts, certificates, roles of clients, handshakes, and the reasons for which they fail.

==============  =======================================================================================================
`context`       Builds `ssl` contexts from TLS options: reads the files, and names a file that is wrong
`failures`      Reasons for which a secure connection failed or ended
`layer`         TLS under asyncio: a layer between the transport of a connection and the protocol that uses it
`roles`         The role of a client, read from its certificate: one UTF-8 string in an extension (MODBUS/TCP Security)
`socket`        TLS over one blocking connection, with the interface of a non-blocking socket
`stream`        The TLS protocol of one connection without IO: encrypted bytes in and out
`certificates`  Certificates: reading what one says (`facts`), and issuing those of a test installation (`authority`)
==============  =======================================================================================================
"""
