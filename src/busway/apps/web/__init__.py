"""The pages of a simulation and of a collector with their APIs: HTTP, one WebSocket, and the files of the pages.

====================  ================================================================================
`hosting`             starts and stops everything: `ControlPage`
`access`              checks Host, Origin, token and size of every request
`connections`         limits number and time of connections
`operations`          the FastAPI application: errors and the OpenAPI document
`messages`            JSON of requests and responses
`api`                 the resources
`stream`              the WebSocket: a snapshot, then changes
`traffic`             the last frames on the wire
`subject`             the interface of a simulation that this package needs
`collector_page`      the API and the page of a collector
`collector_messages`  JSON of its responses
`collector_commands`  commands and the configuration over HTTP
`collector_stream`    its WebSocket: changed values, registers of what is shown, alarms and commands
`collector_log`       what the collector said last, in a bounded ring
`live_values`         last values, and what has changed since a tick
``page``              HTML, style and script
`faults`              faults of a simulation as the API shows and changes them
`page_tokens`         the file with the tokens of a page: made at the first start, for its owner alone
`collector_alarms`    the alarms of a collector and the maintenance of its devices, over HTTP
====================  ================================================================================

1. It needs the extra ``web``, and is imported only when the page is started.
2. It runs in the event loop of the simulation or collector, so it never reads a state that is half changed.
"""
