"""Sinks: other systems that get the samples of a store.

===================  ================================================================================
`interface`          what a sink is: `Sink`, `SinkDown`, `SinkRefused`
`delivery`           one sink: its cursor, batches, patience, loss, samples set aside
`running`            all sinks of a store, in a thread of their own
`options`            a table `[[sink]]` → a sink; secrets from files and the environment
`documents`          samples as JSON, one document for each device and commit
`files`              CSV, JSON lines, Parquet
`mqtt`               MQTT 5, with discovery by Home Assistant
`mqtt_connection`    connects clients of MQTT, and closes those that cannot connect
`postgresql`         PostgreSQL and TimescaleDB
`influxdb`           InfluxDB line protocol over HTTP
`nats`               NATS JetStream
`prometheus`         last values for Prometheus to scrape; no sink, because nothing is sent
`sparkplug`          sparkplug B 3.0 as a sink: the collector is an edge node of a group
`sparkplug_payload`  payloads of Sparkplug B 3.0: metrics with type, time, quality, as bytes and back
===================  ================================================================================
"""
