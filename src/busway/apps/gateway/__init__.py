"""The gateway: forwards requests from any listener to any upstream (Messaging on TCP/IP V1.0b §4.4.2, "MODBUS/TCP to
serial line gateways").

Knows servers and links; a gateway is a server whose handler gives each request to a link. From the top down:

* `configuration`: a gateway made from a file; `file_routes`: its routes; `route_checks` and `policy_gaps`: what of them
  cannot work; `overview`: both as rows of text
* `gateway`: starts, drains, reloads and stops listeners and upstreams, by a `plan`; `status`; `own_unit`: the gateway
  as a device
* `router`: the requests of one listener: route and translate; `routes`, `address_index`, `translation`,
  `decoded_reads`: what it needs for that
* `forwarding`: batches of requests on their way upstream: share, cancel, answer; `read_cache`, `waiter_deadlines`
* `upstream`: connections and their status; `upstream_log`, `exception_codes`: what is told of failures, and to whom
"""
