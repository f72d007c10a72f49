"""Options: endpoints as URLs, options as text or keywords, and presets of options. Does no IO.

==================  ==================================================================================================
`accepted_options`  Which options a component accepts, and the checked parameter objects made of given ones
`client`            Options of a client: the conversation over a link, and its connections
`declaration`       How an option is declared: as one annotated field of a parameter class
`endpoints`         Endpoints: URLs that say where a peer or a serial line is, and how it is spoken to
`gateway`           Options of a gateway: of the whole gateway, of its listeners, and of its upstreams
`lines`             Options of serial lines: the master's timing, the framing, and circuit breakers of units
`networks`          Lists of IPv4 and IPv6 addresses, whether a host is in one, and the texts of clients' addresses
`ports`             Options of a serial port: its line settings, and how it is opened
`presets`           Presets: named sets of options. `strict` meets every "must" of the specifications
`server`            Options of a server: its units, its sessions, and the limits and timeouts of its connections
`service`           Options of what a running server reports: its audit log, its metrics, its control socket
`sinks`             Options of sinks: which samples a sink gets, in what batches, and the options of each kind of sink
`sockets`           Options of network connections, of clients and servers
`text`              Converts options given as text (URLs, command line) or keywords into fields of parameter classes
`tls`               Options of Modbus/TCP Security: certificates, TLS versions, cipher suites and deadlines (port 802)
==================  ==================================================================================================

Where it is decided: range, unit and default of an option: its field in the parameter class (`client`, `server`,
`lines`, `ports`, …), as `declaration` reads it. Which options a component accepts: `accepted_options`. What
`preset=strict` sets, and what it refuses: `presets`. How a text becomes a value, and the error for an unknown option:
`text`. Which other names an option has, such as ``baudrate``: its field (`Alias`). What a URL means: `endpoints`.
"""
