"""The schemas of all files that people write: TOML text to checked, frozen values, with every error at its line.

============  ========================================================================================================
`behaviours`  The schema of behaviours: what makes the value of a simulated point change
`collector`   The schema of collector files: links, poll classes, devices with their profiles, the store and sinks
`device`      The schema of device files: units with their tables and typed, named points
`faults`      The schema of faults that a simulated device has: `[[fault]]`
`gateway`     The schema of gateway files: listeners, links to upstreams, and routes between them
`lines`       Finds the line of each key in a TOML text, because `tomllib` does not report it
`listeners`   The schema of listeners in files: their URLs and the options of their connections
`options`     Keys of a file that are options of a component, generated from the declarations of the options
`points`      The schema of points: `[[unit.point]]` and `[[unit.group]]`, the same in every file that has devices
`policy`      The schema of policies: who may connect, and rules for requests
`problems`    The error for an invalid file, with one line for each problem
`schema`      Base of all file schemas, and the translation of schema errors into sentences with a line
`simulation`  The schema of simulation files: device files whose points have ranges, names for numbers, and behaviours
`sinks`       The schema of sinks: `[[sink]]` of a collector file, one section class for each kind
`system`      The schema of configuration files: server, listeners, client, security, policy and units in one file
============  ========================================================================================================

Knows texts; reads no file itself and builds nothing: `busway.config` does both, `busway.config.devices` makes the
devices. Imported only where a file is used: it loads pydantic.
"""

from ...extras import require

require("pydantic", "a configuration")
