"""Sinks: other systems that get the samples of a store.

===================  ===================================================================================================
`interface`          The interface of sinks, which send samples to other systems, and their errors
`delivery`           Delivery of a store's samples to one sink: reads after the sink's cursor, sends
`sink_thread`        Runs all sinks of a store in a thread with an event loop of its own, so that no sink delays polling
`options`            Makes a sink, and the options of its delivery, from a table `[[sink]]` of the collector file
`hidden_secrets`     Hides passwords and tokens in texts of servers, which may send back what they were sent
`documents`          Converts samples to JSON: one document for each device and commit, or one for each sample
`files`              Sink that writes files: CSV, JSON lines, Parquet
`mqtt`               Sink that publishes samples by MQTT 5, with discovery by Home Assistant
`mqtt_connection`    Connects MQTT clients (aiomqtt), and closes connections that were opened but cannot be used
`home_assistant`     What Home Assistant is told about a point: its kind of entity, device class and state class
`postgresql`         Sink that writes samples to PostgreSQL or TimescaleDB: COPY into a temporary table, then one upsert
`influxdb`           Sink for InfluxDB line protocol over HTTP: InfluxDB 1 to 3, VictoriaMetrics, QuestDB
`nats`               Sink that publishes samples to a stream of NATS JetStream
`nats_connection`    The client of NATS that all connections to its servers have (nats-py)
`prometheus`         The last values of points for Prometheus to scrape. A scrape never polls a device
`sparkplug`          Sink for Sparkplug B 3.0: the collector is an edge node of a group
`sparkplug_payload`  Payloads of Sparkplug B 3.0: metrics with type, time and quality, as protobuf bytes
===================  ===================================================================================================

Where it is decided: what is sent to a sink, in what order, again or never: `delivery`. When a sink that is down is
tried again, and how long samples wait for it: `delivery` (`Delivery.run`); `sink_thread` begins a delivery again only
after an unexpected error. Whether an error means "later" or "refused for good": the file of the sink, by the errors of
`interface`. By which key a receiver knows a sample that comes twice: `documents`. Secrets, TLS and options: `options`;
what an error of a server may show: `hidden_secrets`. Which points there are after a file was read again: `delivery`.
Topics and subjects: `mqtt`, `nats`, `sparkplug`. What Home Assistant makes of a point: `home_assistant`.
"""
