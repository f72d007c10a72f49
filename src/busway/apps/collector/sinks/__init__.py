"""Sinks: other systems that get the samples of a store.

===================  ===================================================================================================
`interface`          the interface of sinks, which send samples to other systems, and their errors
`delivery`           sends a store's samples to one sink: reads after the sink's cursor, sends
`sink_thread`        runs all sinks of a store in a thread with an event loop of its own, so that no sink delays polling
`options`            makes a sink, and the options of its delivery, from a table `[[sink]]` of the collector file
`hidden_secrets`     hides passwords and tokens in error texts of servers, which may repeat what they were sent
`documents`          converts samples to JSON: one document for each device and commit, or one for each sample
`files`              sink that writes files: CSV, JSON lines, Parquet
`mqtt`               sink that publishes samples by MQTT 5, with discovery by Home Assistant
`mqtt_connection`    connects MQTT clients (aiomqtt), and publishes messages with the broker's answer
`home_assistant`     describes a point to Home Assistant: kind of entity, device class and state class
`postgresql`         sink that writes samples to PostgreSQL or TimescaleDB: COPY into a temporary table, then one upsert
`influxdb`           sink for InfluxDB line protocol over HTTP: InfluxDB 1 to 3, VictoriaMetrics, QuestDB
`nats`               sink that publishes samples to a stream of NATS JetStream
`nats_connection`    makes the NATS client (nats-py) for all connections to NATS servers
`prometheus`         the last values of points, for Prometheus to scrape; a scrape never polls a device
`sparkplug`          sink for Sparkplug B 3.0: the collector is an edge node of a group
`sparkplug_payload`  payloads of Sparkplug B 3.0: metrics with type, time and quality, as protobuf bytes
===================  ===================================================================================================

Where it is decided: what is sent to a sink, in what order, again or never (``points``, ``most``, ``age``): `delivery`.
When a sink that is down is tried again, how long samples wait for it (``keep``), and how many were dropped
(`SinkStatus.lost`): `delivery` (`Delivery.run`, `Delivery._drop_old`); after an unexpected error `sink_thread` runs a
delivery again. Which sinks begin and end with a file that was read again: `busway.apps.collector.connected_systems`;
which points there are then: `delivery`. Which of its samples a point hands on (``report``):
`busway.apps.collector.report_rules`. Whether an error means "later" or "refused for good": the file of the sink, by the
errors of `interface`. Which key a sample has when it comes twice: `documents`. Secrets, TLS and options: `options`;
what an error of a server may show: `hidden_secrets`. Topics and subjects: `mqtt`, `nats`, `sparkplug`. What Home
Assistant makes of a point: `home_assistant`.
"""
