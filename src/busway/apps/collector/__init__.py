"""The collector: polls devices and keeps what they say.

==============  =======================================================================
`cost`          what a read costs on the wire
`knowledge`     what was learnt of devices, as values and as text
`learning`      learning what reads cost, and which a device refuses
`plan`          the cheapest reads for the points that are due
`samples`       a sample, its quality and reason; the samples of one read; intervals without reads
`store`         the folder that keeps samples: written, sealed, read
==============  =======================================================================
"""
