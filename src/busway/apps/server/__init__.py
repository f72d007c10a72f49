"""`busway serve`: a server put together from one file, and its policy, logs and metrics.

=================  ===================================================================================
`configuration`    `load_configuration`, and the object that holds every parameter (clause T33)
`effective`        the effective configuration, defaults included, as TOML
`overview`         what a configuration says, as rows of text: listeners, rights, links and units
`service`          a server with policy, audit log, metrics and control socket: starts and stops them
`reload`           reading the files again while the server runs, and applying what changed
`access_in_force`  the policy and address lists of a running service, which a reload replaces
`overrides`        what the command line says instead of the file
`interfaces`       what a service runs (server, gateway, simulation), and the configuration that declares it
=================  ===================================================================================
"""
