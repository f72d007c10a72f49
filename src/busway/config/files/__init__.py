"""The schemas of all files that people write: TOML text to checked, frozen values, with every error at its line.

================  ======================================================================================================
`behaviours`      Keys of simulation files for behaviours: what makes the value of a simulated point change
`collector`       The schema of collector files: links, poll classes, devices with their profiles, the store and sinks
`device`          The schema of device files: units with their tables and typed, named points
`error_wording`   The wording of errors in files: the sentence for a wrong key or value, and hints ("is it …?")
`fault_sections`  Keys of `[[fault]]` that all faults have: which requests, when; not the parameters of one profile
`file_error`      The error that holds all problems of one invalid file, a line each; `error_wording` words them
`gateway`         The schema of gateway files: listeners, links to upstreams, and routes between them
`key_lines`       Finds the text line of each key in a TOML file, for error messages (`tomllib` does not tell)
`listeners`       Keys of files for listeners: their URLs and the options of their connections
`options`         Keys of files that set options: generated from the declarations of the options
`points`          Keys of files for points: `[[unit.point]]` and `[[unit.group]]`, the same in all files with devices
`policy`          Keys of access policies: who may connect, and rules for requests
`section`         Base class of the sections of all files: each field is a key, with its type, range and help
`simulation`      The schema of simulation files: device files whose points have ranges, named numbers, and behaviours
`sinks`           Keys of `[[sink]]` in collector files, one section class for each kind of sink
`system`          Keys of configuration files: server, listeners, client, security, policy and units in one file
`toml_source`     A parsed TOML file with the line of each key, and its check by a section class
================  ======================================================================================================

Knows texts; reads no file itself and builds nothing: `busway.config` does both, `busway.config.devices` builds the
devices. Import this package only where a file is used: it loads pydantic, and raises `MissingExtra` without it.

Where it is decided: how an error in a file is worded, also the hint "is it …?": `error_wording`; which key it names:
`busway.values.similar_names`. Which keys a section has: the file of its kind. Which options are keys: `options`, from
their declarations. In which line a key is: `key_lines`. Which parameters a fault has: no file here, but the function of
its profile in `busway.faults.profiles`.
"""

from ...extras import require

require("pydantic", "a configuration")
