"""The collector: polls devices and keeps what they say.

==============  =======================================================================
`cost`          what a read costs on the wire
`plan`          the cheapest reads for the points that are due
`samples`       a sample, its quality and reason; the samples of one read; intervals without reads
==============  =======================================================================
"""
