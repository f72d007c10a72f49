"""The store of the collector: the folder in which it keeps samples.

====================  =========================================================================================
`folder`              names of the store's files, the lock of its writer, making changes durable (fsync)
`manifest`            the list of a store's files, points and sinks, with the cursor of each sink
`segment`             the SQLite file that samples are written to, and when it ends and the next begins
`writer`              writes one commit after the other into the open segment; undoes one that fails
`recovery`            closes what an earlier process left open, and finds the gap since its end
`committer`           the thread that commits several times a second, and drops samples when the disk is full
`sealing`             turns a segment that has ended into Parquet files
`sealed_writer`       writes the Parquet files of a segment; runs as a program of its own
`kept_samples`        which samples are kept, where a rule says that not all of them are
`retention`           which files are deleted because they are too old or the store is too large
`alarm_events`        reads alarm events from the manifest and the open segment; deletes old ones
`accumulator_states`  the totals of accumulators, from which a collector goes on after a restart
`clock_correction`    corrects the times of samples stored before the wall clock was set
`part_reader`         reads samples and sums from one part of the store: a segment or a sealed file
`sealed_reader`       reads samples and sums from Parquet files, with DuckDB where it is installed
`file_rows`           forms of samples read from files of a store: rows, and sums by time bucket
`selection`           parses the points, times and periods of a query
`store_reader`        `Store`: reads rows and buckets of all files as one
`query_results`       results of queries: columns of samples or buckets; also as Arrow, pandas or polars tables
`committed_samples`   reads samples in the order of their commits, for sinks
`check`               checks the files of a store for damage, also while it is written
`backup`              backs up a store, also while it is written, and restores it
`database`            connections to the SQLite files of a store, and transactions on them
====================  =========================================================================================

Where it is decided: when a segment ends: `segment` (`Segment.has_ended`); how durable a commit is (``durability``):
`segment` by its pragmas, `committer` by its syncs. Which files belong to the store: `manifest`. When a segment is
sealed: `writer`; in which steps, and what a crash between them leaves: `sealing`; which rows a sealed file has, and
what is late: `sealed_writer`. Which of two samples of one point and time counts, in parts that overlap: `store_reader`.
Which samples are kept: `kept_samples`. What is deleted (``keep_days``, ``keep_bytes``): `retention`. When a commit is
made, and what is dropped when the disk is full: `committer`. Which samples get another time when the clock is set:
`clock_correction`. What a crash leaves is put right at the next start by `recovery`; a half-written commit is undone by
SQLite itself. Whether a command was sent before the crash is not in a store: `busway.apps.collector.commands.journal`.
"""
