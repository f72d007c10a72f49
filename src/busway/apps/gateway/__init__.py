"""The gateway: any listener, any upstream (Messaging on TCP/IP V1.0b §4.4.2, "MODBUS/TCP to serial line gateways").

Knows servers and links; a gateway is a server whose handler hands each request to a link.

* ``routes``: which upstream and unit a request belongs to; ``translation``: what it looks like there
* ``upstream``: its links; ``sharing``: identical reads in flight; ``cache``: reads answered from memory
* ``handler``: one listener's requests, from arrival to answer; ``own_unit``: the gateway itself as a device
* ``gateway``: the whole, with its life: start, drain, reload, status
"""
