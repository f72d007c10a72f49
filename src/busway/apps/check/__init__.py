"""`busway check`: tests whether a device does what the specifications ask for, and reports what it does not do.

============  ==========================================================================================
`check`       What a check is, and its result: plain data
`catalogue`   The checks: made for a target, in the order in which they run
`clauses`     The clauses that checks belong to, in a few words each
`frames`      Frames of checks: requests as bytes, also damaged ones, and replies found in what was received
`judgement`   Judges what came back for a request: which facets of the exchange are wrong
`wire`        Connections over which checks send bytes as they are: TCP, TLS and serial ports
`tls_wire`    Connections whose TLS handshake a secure device must refuse: old versions, weak suites, no certificate
`run`         Runs checks against a device, one after the other, and gives the result of each
`summary`     The results of a run: counts, comparison with an earlier run, and whether the device passed
`reports`     Reports of a run: Markdown, JSON, JUnit XML and HTML
============  ==========================================================================================

Pure are `check`, `catalogue`, `frames`, `judgement` and `summary`; `wire` and `tls_wire` have the sockets and ports,
`run` the clock.

Where it is decided: what is sent for a clause and what is accepted: `catalogue`. Whether a reply is right: `judgement`.
What that means for the check (passed, failed, warned, not offered): `run`. How a frame is damaged: `frames`. Whether a
device has died, and what is restored: `run`. Whether a run has failed: `summary`.
"""
