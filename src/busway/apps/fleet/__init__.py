"""The fleet: several collectors that share the links of a plant, each link polled by one of them.

=====================  =================================================================================================
`shards`               the groups of links that are owned together, and which hosts may own them
`coordinator`          the interface of the table that collectors change by compare-and-set
`coordinators`         its backends: one file, NATS JetStream, PostgreSQL
`lease_times`          until when an owner may send, from when another may take the shard
`epoch`                the number of a shard's owner, greater than that of every owner before
`table_records`        what collectors share: leases, members, the generation, the settings of the zone
`balance`              which collector takes a free shard, and which shards move
`lease_holder`         one collector in its zone: what it owns, takes, renews, hands on, and when it must stop polling
`lease_driver`         runs a lease holder by asyncio on a coordinator
`plant_configuration`  the part of a plant's configuration that one collector works on
`control_entries`      the entries of operators: the plant's configuration, and which collectors are drained
`fleet_status`         the status of a zone: collectors, owners of shards, configuration
`zone_watch`           follows a zone for its web page: the status now, and times in which shards had no owner
`stream_head`          the number of the newest message of a zone's stream, for the lag of sinks on the page
`fleet_metrics`        the metrics of one collector in its fleet, for Prometheus
`ownership_log`        the record of what this collector owned when, and of the epoch of its samples; it decides nothing
`ownership_gaps`       times in which a link had no owner, and how samples that arrive late shrink them
`messages`             samples of one link as a message
`outbox`               what a collector has stored, sent until the sinks of the fleet have it
`streams`              the stream of a zone: samples go in from collectors, and out to sinks
`chosen_samples`       passes on to a sink the samples of the stream that it wants: its points, by report rules
`fleet_collector`      a collector that polls what it owns
`fleet_commands`       commands by request and reply on a subject of the link
`key_memory`           the keys of commands that one entry of the table remembers, and for how long
`key_table`            the keys of all commands of a zone: each is sent at most once, whatever way it came
`durability`           what the NATS servers keep when they lose power, as they say it themselves
`server_rights`        what each role may do at the NATS servers, as data
`server_files`         configuration files of NATS servers, as text
`live_subjects`        last values on plain subjects, for displays
=====================  =================================================================================================

Where it is decided: which links make a shard, and which hosts may own it: `shards`. Whether this collector owns a shard
now, and whether one more transaction may begin before its lease ends (fencing): `lease_holder` (`LeaseHolder.permits`);
for how long a lease holds (``ttl``, ``guard``): `lease_times`; which of two owners is the later one: `epoch`. Whether a
request of an old owner may still reach the device, also out of the queue of a gateway (``gateway_wait``):
`plant_configuration`. Which collector takes a free shard, and which shards move: `balance`. Which change wins when two
are made at once: `coordinator` (compare-and-set). To which epoch a sample belongs: `ownership_log`. What becomes of
samples that an old owner still sends: they are kept, under the epoch in which they were taken (`messages`). How long a
gap of ownership really was: `ownership_gaps`. Which samples are sent again: `outbox`. Whether a command was sent
before: `key_table`; how long that is known: `key_memory`.
"""
