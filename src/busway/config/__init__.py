"""Configuration: reads files that people write, checks them, and builds components from them (Messaging on TCP/IP V1.0b
§4).

==================  ==========================================================================
`files`             the schemas: TOML text to frozen values, with every error at its line
`devices`           device files → devices that can be served
`links`             the options of a named link
`certificates`      the certificates that a listener uses
`reloadable_access` allow lists and default rules that can be replaced while a server runs
`preflight`         checks before anything runs: roles that no client can have, files that cannot be read
`report`            the problems and warnings of a file, each with the line of its key
`paths`, `reading`  files by their names
==================  ==========================================================================
"""
