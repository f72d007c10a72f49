"""The common base of the services (server, gateway, simulator, collector, fleet): one file, start, reload, stop.

==========================  ==========================================================================================
`access_in_force`           The access policy and address lists that a service applies, and how a reload replaces them
`configuration`             The configuration of a server and its clients from one file, checked as a whole
`effective`                 Shows the configuration in force, defaults included, as TOML
`file_warnings`             Logs the warnings about a configuration at the start, and when it is read again
`gc_pauses`                 Keeps the garbage collector from pausing the event loop while many objects come or go
`listeners_without_policy`  Listeners without a policy: those that the network can reach are read-only
`overrides`                 Command-line overrides of a configuration: other listeners, a policy file, an audit log
`overview`                  An overview of a configuration as rows of text: listeners, rights, links and units
`reload`                    Reads a configuration again while its server runs, and applies what can change then
`reloadable_sections`       The sections of a file whose changes a reload applies without a restart
`service`                   A running server and the services around it: policy, audit log, metrics and control socket
`service_interfaces`        Interfaces of what a service runs (a server, a gateway or a simulation)
==========================  ==========================================================================================

Where it is decided: which sections a reload applies without a restart, for server, simulator and gateway:
`reloadable_sections`; for a collector: `busway.apps.collector.reload`. Whether a reload replaces the policy, and which
connections it ends (those of hosts that may no longer connect): `reload`; from which request on the new policy holds:
`busway.access.authorizer`. Which parts of the file the command line can replace
(``--listen``, ``--priority``, ``--audit`` …), and whether file or command line counts: `overrides`. Which keys a
configuration has, and what must fit together: `configuration`. Which policy and which allow list apply now:
`access_in_force`. That a listener without a policy is read-only where the network reaches it:
`listeners_without_policy`. The order of start and stop: `service`.
"""
