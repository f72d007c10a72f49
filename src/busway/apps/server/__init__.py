"""`busway serve`: a server put together from one file, and its policy, logs and metrics.

=================  ==========================================================================================
`access_in_force`  The policy and the address lists that a running service applies, which a reload replaces
`configuration`    The configuration of a whole system from one file: every parameter, checked together
`effective`        The effective configuration, defaults included, as TOML
`interfaces`       Interfaces of what a service runs (a server, a gateway or a simulation)
`overrides`        Command-line overrides of a configuration
`overview`         An overview of a configuration as rows of text: listeners, rights, links and units
`reload`           Reload of a configuration while its server runs
`service`          A running server and the services around it: policy, audit log, metrics and control socket
=================  ==========================================================================================
"""
