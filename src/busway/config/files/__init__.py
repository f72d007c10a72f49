"""Files that people write: TOML text → checked, frozen values, with every error at its line.

Knows texts; reads no file itself (the command line does) and builds nothing (`busway.simulator.build` does). Imported
only where a file is used: it loads pydantic.

==============  =======================================================================
`lines`         at which line each key of a TOML text stands
`problems`      everything that is wrong with a file, as one error
`schema`        how a schema's violations become sentences
`device`        the schema of device files, and `parse_device_file`
==============  =======================================================================
"""
