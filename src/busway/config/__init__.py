"""From files that people write to checked values, and from those to components (Messaging on TCP/IP V1.0b §4).

==================  ==========================================================================
`files`             the schemas: TOML text to frozen values, with every error at its line
`devices`           the devices of a device file, built
`links`             the options of a named link
`certificates`      those of a listener, as they hold in the end
`live_access`       who may do what while a server runs: rules that can be replaced
`preflight`         what can be said before anything runs
`report`            what components say about the values of a file, each with the line of its key
`paths`, `reading`  files by their names
==================  ==========================================================================
"""
