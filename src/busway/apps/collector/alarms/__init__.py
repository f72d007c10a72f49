"""Alarms of points: limits and states, with delay, hysteresis, acknowledgement and a journal.

===========  ==============================================================================================
`events`     The events of alarms (raised, acknowledged, cleared, removed), and what an alarm is after each
`machine`    The state machine of one alarm: takes samples of its point, returns alarm events
`book`       The alarms of all points of a collector, and which sample belongs to which alarm
`collected`  The alarms of a running collector: what programs and the page can see of them and do with them
===========  ==============================================================================================
"""
