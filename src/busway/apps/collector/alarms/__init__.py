"""Alarms of points: limits and states, with delay, hysteresis, acknowledgement and a journal.

==================  ==================================================================================================
`collector_alarms`  the alarms of a running collector: lists, acknowledges and follows them, for programs and the page
`events`            the events of alarms (raised, acknowledged, cleared, removed), and what an alarm is after each
`machine`           the state machine of one alarm: takes samples of its point, returns alarm events
`point_alarms`      the alarms of all points of a collector, and which sample belongs to which alarm
==================  ==================================================================================================
"""
