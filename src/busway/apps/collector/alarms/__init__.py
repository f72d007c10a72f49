"""Alarms of points: limits and states, with delay, hysteresis, acknowledgement and a journal.

=============  ========================================================================
`events`       what happens to an alarm, and what an alarm is after it
`machine`      one limit of one point: values in, events out
`book`         the machines of all points; the file is read again, a start after a crash
`collected`    `CollectorAlarms`: what programs and the page use
=============  ========================================================================
"""
