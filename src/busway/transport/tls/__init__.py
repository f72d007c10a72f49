"""TLS: contexts, certificates, roles of clients, handshakes, and the reasons for which they fail.

==============  ========================================================================================================
`context`       Builds `ssl` contexts from TLS options: reads the files, and names a file that is wrong
`failures`      Reasons why a TLS connection failed or ended: as text for an operator, and as a kind for counters
`layer`         TLS for asyncio connections: a layer between the transport of a connection and the protocol that uses it
`renewal`       Keeps an `ssl` context up to date: certificate files that have changed are read again
`roles`         The role of a client, read from its certificate: one UTF-8 string in an extension
`socket`        TLS for blocking clients: a connection with the methods of a non-blocking socket
`stream`        TLS of one connection without IO: encrypted bytes in and out
`certificates`  Certificates: reading what one says (`facts`), and issuing those of a test installation (`authority`)
==============  ========================================================================================================

Where it is decided: which versions, ciphers and authorities are accepted (``minimum_version``, ``authority``,
``verify``, ``revocation_list``): `context`. When changed certificates hold: `renewal`. Why a handshake failed:
`failures`. Which role a client has: `roles`; whether one without a role is admitted (``require_role``):
`busway.server.tls_admission`; what it may do then: `busway.access.rules`. When a TLS connection has ended: `stream`.
"""
