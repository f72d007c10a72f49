"""The collector: polls devices by a plan and stores their values as samples.

===================  ===================================================================================================
`cost`               The cost of reads in seconds: a base for each request, a part for each register or bit
`plan`               The read plan: the cheapest set of reads that fetches all wanted points of a device
`knowledge`          What was learnt about devices (refused ranges, largest reads, read costs), as values and as JSON
`learning`           Learns from the reads of a device what they cost, and which ranges it refuses
`plan_cache`         Cache of one device's read plans, one for each set of poll classes that are due together
`schedule`           The schedule of one link: which read request is sent next, and when
`silent_devices`     The silent devices of one link: when a device that does not answer is probed again
`admission`          Admission test before the start: whether each link can keep the poll periods of its devices
`poller`             Polls the devices of one link: sends the reads of the schedule, and turns replies into samples
`permitted_link`     A link that asks for permission before each transaction
`held_values`        When the last value of a point is held: older than it should be
`derived_points`     Totals, computed points, and members of groups of variable size, of one device
`adaptive_timeout`   The adaptive timeout for replies of one polled device: adapts on TCP, not on serial lines
`sample_clock`       The clock that gives samples their time: follows the wall clock, never runs backwards
`time_service`       Whether a time service keeps the wall clock right: what the kernel says, and what that means
`configuration`      Reads a collector file into links, devices with their points, and read plans
`collector`          The collector: polls the devices of its file, stores their samples, and passes them on to sinks
`preview`            What a collector would do, without traffic: its reads, the load of each link, undeclared registers
`samples`            Samples: the value of a point at a time, its quality, and the reason if it is not good
`store`              The store of the collector: the folder in which it keeps samples
`commands`           Commands: values that people and programs write to points of a running collector, each at most once
`command_targets`    Finds points of a running collector for commands to write, and their last values
`device_status`      The status of a polled device: whether it answers, and what its reads have brought
`learnt_file`        The file beside the store in which a collector keeps what it learns about devices, over restarts
`sample_readers`     The programs that follow the samples of a running collector
`running_notes`      Notes that let `busway status` find the running collectors of this user
`report_rules`       Which report rule holds for a point, in the store and towards sinks
`reload`             Replaces the configuration of a running collector, from its file or a text that becomes its file
`point_names`        Which points have other names after the configuration was read again: for store, alarms and totals
`sinks`              Sinks: other systems that get the samples of a store
`alarms`             Alarms of points: limits and states, with delay, hysteresis, acknowledgement and a journal
`dashboards`         Dashboards for Grafana: one for the collector's page for Prometheus
`cancellation`       Ends tasks, also where a library swallows their cancellation
`task_errors`        Errors with which tasks end: the error inside a group of errors, and the line in the log
`maintenance`        Devices in maintenance, which are not polled: which, since when, who began it, and why
`connected_systems`  The other systems that a running collector is connected to: sinks, pages, servers with commands
===================  ===================================================================================================

Where it is decided: which registers one read fetches: `plan`. What a device refuses, and how long its reads take:
`learning`. Which device is asked next, and which rounds are skipped: `schedule`. When a dead device is left out, and
how soon it is asked again: `silent_devices`. Whether a link has too much to do: `admission`. The time of a sample:
`poller` and `sample_clock`; whether the wall clock is right (``clock``): `time_service`. When a value is held:
`held_values`. Which samples are stored or handed on (``store_report``, ``report``): `report_rules`; when such a rule
lets one pass (``deadband``): `busway.points.point_rules`. What a reload changes: `reload`; which sinks, pages and
inputs begin and end with it: `connected_systems`; which point is which after it (``was``): `point_names`. Why a sample
has no value, or a doubtful one: `poller` for the read, `busway.points` for its decoding. When a counter has begun
again: `busway.points.derived`. Why a device is not polled: `maintenance` (by people), `silent_devices` (it does not
answer), `permitted_link` (another collector owns the link). Whether a collector of a fleet may still poll:
`permitted_link` asks, `busway.apps.fleet.lease_holder` decides. When an alarm is raised: `alarms`. Who may write a
point, and whether a command is sent twice: `commands`. What is remembered of devices over a restart (``learn``):
`learnt_file`; of samples: `store`.
"""
