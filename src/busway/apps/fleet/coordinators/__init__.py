"""Coordinators: backends that keep the rules of `busway.apps.fleet.coordinator`.

============  =============================================================================================
`local`       The coordinator for collectors on one machine: a table in an SQLite file
`nats`        The coordinator on NATS JetStream: one key-value bucket for each zone
`opening`     Opens the coordinator of a fleet by its URL, whose scheme names the backend
`outages`     Logs when the watches of a coordinator cannot follow its table, and when they follow it again
`postgresql`  The coordinator on PostgreSQL: one table of the database has the entries of all zones
============  =============================================================================================

Where it is decided: which backend a URL means, and how long a server that does not answer yet is waited for: `opening`.
Which of two changes wins, and when a watch begins anew: the file of the backend, such as `nats`. What a collector may
do meanwhile: `busway.apps.fleet.lease_holder`.
"""

from .opening import open_coordinator

__all__ = ["open_coordinator"]
