"""Alarms of points: limits and states, with delay, hysteresis, acknowledgement and a journal.

==================  ==================================================================================================
`collector_alarms`  the alarms of a running collector: lists, acknowledges and follows them, for programs and the page
`events`            the events of alarms (raised, acknowledged, cleared, removed), and what an alarm is after each
`machine`           the state machine of one alarm: takes samples of its point, returns alarm events
`point_alarms`      the alarms of all points of a collector, and which sample belongs to which alarm
==================  ==================================================================================================

Where it is decided: when an alarm is raised and cleared (``delay``, ``hysteresis``), and whether a person has to
acknowledge it (``acknowledge``): `machine`; whether a value is beyond its limit: `busway.points.point_rules`
(`AlarmRule.is_beyond`). Which sample belongs to which alarm, and what becomes of an alarm when the file is read again:
`point_alarms`. What an alarm is after an event, also after a restart: `events`.
"""
