"""The collector: polls devices by a plan and stores their values as samples.

================  ==========================================================================================
`cost`            what a read costs on the wire
`plan`            the cheapest reads for the points that are due
`knowledge`       what was learnt of devices, as values and as text
`learning`        learning what reads cost, and which a device refuses
`plan_cache`      the plans of one device, by the classes that are due
`schedule`        which read of a link is next, and when
`admission`       whether a link can do what its devices are to be asked
`poller`          the polling engine of one link
`permitted_link`  a link each transaction of which must be permitted
`derived_points`  totals, computed points, members of groups that a count names
`reply_timeout`   how long to wait for a device
`sample_clock`    the clock of samples, which never runs back
`configuration`   a collector file → links, devices, plans
`collector`       all of it, running: links, store, readers, reading the file again
`preview`         what a collector would do, told before it does it
`samples`         a sample, its quality and reason; the samples of one read; intervals without reads
`store`           the folder that keeps samples: written, sealed, read
`commands`        values that are written to points, each at most once
`report_rules`    which report rule holds for a point, in the store and towards sinks
`reloading`       what another configuration may change while a collector runs
`renaming`        which points have other names after the configuration was read again
`sinks`           other systems that get what a store keeps
`alarms`          alarms of points: limits and states, with delay, hysteresis, acknowledgement and a journal
`dashboards`      dashboards for Grafana: one for the collector's page for Prometheus
`maintenance`     devices in maintenance: which, since when, who began it, and why
================  ==========================================================================================
"""
