"""The control API of a simulation, and its page: HTTP, one WebSocket, and files that a browser gets.

===============  =======================================================================
`hosting`        starts and stops it all: `ControlPage`
`access`         who may ask: Host, Origin, token, sizes
`operations`     the application, how errors are answered, and the OpenAPI document
`messages`       what is asked and answered, as JSON
`api`            the resources themselves
`stream`         the WebSocket: a snapshot, then what changes
`traffic`        the frames that pass, kept for whoever looks
`subject`        what is controlled, as far as this part needs to know it
``page``         HTML, style and script
===============  =======================================================================

1. It needs the extra ``web``, and is imported only where it is asked for.
2. It runs in the event loop of the simulation: what it reads is never half changed.
"""
