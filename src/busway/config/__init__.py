"""Configuration: reads files that people write, checks them, and builds components from them.

The specification describes the configuration of a system in Messaging on TCP/IP V1.0b §4.

===============  =================================================================================================
`certificates`   The certificates of a listener: whether they can be used
`device_writes`  Refuses Modbus writes that do not fit the points of a device, such as values outside their range
`devices`        Builds the devices of a server from the contents of device files
`file_text`      Reads the text of a configuration file; refuses one that is not UTF-8 or too large
`files`          The schemas of all files that people write: TOML text to checked, frozen values
`links`          The links that a configuration names: endpoint and options, checked as `busway.open` would
`parameters`     Parameters of device files: names in the file's texts that an include replaces by values
`paths`          Paths in a configuration file: absolute, or relative to the folder of the file
`preflight`      Checks before the start: access rules that can never match, files that cannot be used
`profiles`       Ready-made device profiles: simulation files that come with the package, each with its parameters
`report`         The report of a configuration file's problems, each with the line of its key
`toml_text`      Writes texts and keys in TOML syntax
===============  =================================================================================================

Where it is decided: which keys a file has, and how an error in it is worded: `files`. At which key a wrong combination
is reported: `report`. Which rules can never match: `preflight`. Whether a certificate can be used: `certificates`.
Which values Modbus clients may write to a device (``minimum``, ``maximum``; why a write is answered 04):
`device_writes`. Relative to which folder a path is: `paths`. What `${NAME}` in a device file becomes: `parameters`.
Which options a link of a file has, and whether its table, its URL, ``[client]`` or a preset counts: `links`. For a
listener: `busway.apps.service.configuration` (table, ``[server]``, ``[security]``) and
`busway.server.listener_settings` (URL). That table and URL cannot give an option with different values:
`busway.config.files.options`. What the command line replaces: `busway.apps.service.overrides`. Where variables of the
environment are read: ``BUSWAY_FLEET`` in `busway.cli.fleet_folder`, the others of a fleet in `busway.cli.fleet`,
``BUSWAY_CLOCK`` in `busway.apps.collector.time_service`, ``BUSWAY_TRACEBACK`` in `busway.cli.program`.
"""
