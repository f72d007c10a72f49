"""Configuration: reads files that people write, checks them, and builds components from them (Messaging on TCP/IP V1.0b
§4).

===================  =================================================================================================
`certificates`       The certificates of a listener: options of its URL override its section
`device_writes`      Refuses Modbus writes that do not fit the points of a device, such as values outside their range
`devices`            Builds devices that a server can serve from the contents of device files
`gc_pauses`          Keeps the garbage collector from pausing the event loop while many objects are created or freed
`links`              The named links of a configuration: endpoint and options, checked as `busway.open` would
`parameters`         Parameters of a device file: put into its texts before its schema checks them
`paths`              Paths in a configuration file: absolute, or relative to the folder of the file
`preflight`          Checks of a configuration before it runs: rules that can never match, files that cannot be used
`reading`            Reads the text of a configuration file
`reloadable_access`  Allow lists and default rules that can be replaced while a server runs
`report`             The configuration report: the problems of a file's values, each with the line of its key
`files`              The schemas of all files that people write
`profiles`           Ready-made device profiles: simulation files that come with the package, each with its parameters
===================  =================================================================================================
"""
