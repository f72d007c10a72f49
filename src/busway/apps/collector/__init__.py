"""The collector: polls devices and keeps what they say.

==============  =======================================================================
`samples`       a sample, its quality and reason; the samples of one read; intervals without reads
==============  =======================================================================
"""
