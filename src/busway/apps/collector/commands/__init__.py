"""Commands: values that people and programs write to points of a running collector, each at most once.

===============  =======================================================================================================
`command`        Commands: a value to be written to a point, who asked for it and until when, and its result
`point_write`    The request that writes a value to a point, and the check whether the device shows the value afterwards
`point_read`     The request that reads one point alone, before or after a command, within what its device allows
`journal`        The record of each command and its result, written before the command is sent
`claims`         The interface through which a collector of a fleet takes keys of commands for all collectors
`other_owners`   The interface through which a collector of a fleet deals with commands for links of other collectors
`runner`         Executes commands that write points of a running collector: checks, records, sends, reads back, reports
`audit`          Audit lines, as JSON, for commands that write points and for changes of the configuration
`targets`        Finds points of a running collector as targets of commands, and their last values
`inputs`         Commands that arrive as messages: which points they may write, how they are answered
`input_options`  Reads the key `commands` of a sink's table: makes what receives commands from the sink's server
`message_tasks`  The tasks that handle messages of one broker connection; all of them end before the connection is left
`mqtt`           Receives commands to write points from an MQTT 5 broker
`nats`           Receives commands to write points by NATS request and reply
`sparkplug`      Receives commands from host applications of Sparkplug B, over the connection of the sink
===============  =======================================================================================================

Where it is decided: which points the commands of one server may write, and whether a message came too late: `inputs`.
Whether a command was given before (also before a crash), and what it gets then: `journal`, in a fleet `claims` too. The
order of check, record, write and report: `runner`. Which values a point takes, and whether the device shows them
afterwards: `point_write`. How many messages wait at once: `message_tasks`. What the audit log says: `audit`.
Which collector of a fleet executes and answers a message: `inputs`, by what `other_owners` says.
"""
