"""Commands: values that people and programs write to points of a running collector, each at most once.

==================  ====================================================================================================
`command`           a command and its result: a value to be written to a point, by whom, until when
`point_write`       the request that writes a value to a point, and the check whether the device shows it afterwards
`point_read`        the request that reads one point alone, before or after a command, within what its device allows
`journal`           the record of each command and its result, written before the command is sent
`claims`            the interface through which a collector of a fleet takes keys of commands for all collectors
`other_owners`      the interface through which a collector of a fleet deals with commands for links of other collectors
`runner`            executes commands that write points of a collector: checks, records, sends, reads back, reports
`audit`             audit lines, as JSON, for commands that write points and for changes of the configuration
`rights`            whether a writer may write a point: by its role, and by whether the command was armed
`command_messages`  commands as messages: what they may write, whether one came again or too late, the answer
`input_options`     makes the receiver of commands that the key `commands` of a sink's table asks for
`message_tasks`     the tasks that handle messages of one broker connection; all end before the connection is left
`mqtt`              receives commands to write points from an MQTT 5 broker
`nats`              receives commands to write points by NATS request and reply
`sparkplug`         receives commands from host applications of Sparkplug B, over the connection of the sink
==================  ====================================================================================================

Where it is decided: whether a writer may write a point (``role``, ``armed``): `rights`. Which points the commands of
one server may write, and whether a message came too late or was retained by its broker: `command_messages`. Whether a
command was given before (also before a crash; why a write was not sent twice), and what it gets then: `journal`, in a
fleet `claims` too. The order of check, record, write and report: `runner`. Which values a point takes (``minimum``,
``step``), whether the device shows them afterwards (``verify``), and when the outcome is unknown: `point_write`. How
many messages wait at once: `message_tasks`. What the audit log says: `audit`. Which collector of a fleet executes and
answers a message: `command_messages`, by what `other_owners` says.
"""
