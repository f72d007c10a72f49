"""Commands: values that people and programs write to points of a running collector, each at most once.

===============  =====================================================================================
`command`        a command, its result, and what it may look like
`point_write`    the request that writes a value to a point, and whether it was written
`point_read`     the request that reads one point alone
`journal`        the file that keeps commands and results: recorded before the wire
`runner`         checks, records, sends and confirms commands
`audit`          lines of the audit log for commands and changes of the configuration
`targets`        the points of a running collector as targets of commands, and what they are known to be
`inputs`         commands that come by messages: which points, what they look like, what is answered
`input_options`  the table of a file that permits them
`message_tasks`  the tasks that handle messages; they end with their connection
`mqtt`           commands by MQTT 5
`nats`           commands by NATS request and reply
===============  =====================================================================================
"""
