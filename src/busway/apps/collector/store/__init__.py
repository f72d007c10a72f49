"""The store of the collector: the folder in which it keeps samples.

===================  ===================================================================================
`folder`             names of its files, the lock with the pid of its writer, fsync of folders
`manifest`           what is in the folder: parts, points, cursors, files to unlink
`segment`            the part that is written: one SQLite file
`sealing`            a finished segment → Parquet
`writer`             commits, one after the other: rolls, seals, drops; survives a full disk
`commit_thread`      the thread that commits for an event loop, every quarter of a second
`retention`          which parts are too old or too many
`journal`            the journal of alarms, and how far accumulators are
`mending`            samples from before the wall clock was set
`parts`              rows of one part, whatever its format
`selection`          which points, which time
`reading`            `Store`: rows and buckets of all parts as one
`frames`             what a query gives; as Arrow, pandas or polars
`committed_samples`  rows in the order of their commits, for sinks
`upkeep`             check, backup, restore, while it runs
`database`           connections to the SQLite files of a store
`sealed_part`        A sealed part: the rows of a segment as a Parquet file. Run as a program of its own
===================  ===================================================================================
"""
