"""The schemas of all files that people write: TOML text to checked, frozen values, with every error at its line.

Knows texts; reads no file itself and builds nothing: `busway.config` does both, `busway.config.devices` makes the
devices. Imported only where a file is used: it loads pydantic.

==============  =======================================================================
`lines`         at which line each key of a TOML text stands
`problems`      everything that is wrong with a file, as one error
`schema`        how a schema's violations become sentences, and its JSON Schema
`options`       keys that are options of a component, made from its parameter class
`device`        the schema of device files, and `parse_device_file`
`behaviours`    the schema of what makes values change
`simulation`    the schema of simulation files
`listeners`     where a file says to listen, and who may connect there
`policy`        the schema of policies
`system`        the schema of configuration files: all of it
`gateway`       the schema of gateway files
==============  =======================================================================
"""

from ...extras import require

require("pydantic", "a configuration")
