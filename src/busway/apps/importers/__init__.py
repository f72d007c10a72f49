"""Importers: convert device descriptions of other programs into device files, and report what was left out.

================  ==============================================================================================
`formats`         Chooses the importer for a device description of another program, by the file's form
`home_assistant`  Importer for Home Assistant: its `modbus:` configuration
`imported`        The result of an import: points put together into units, checked, and written as a device file
`modpoll`         Importer for modpoll: its CSV of lines `device`, `poll` and `ref`
`plain_yaml`      Reads plain data from YAML by PyYAML (`busway[yaml]`), with the line of each key and item
`sunspec`         Importer for SunSpec: models in JSON
`telegraf`        Importer for Telegraf: its `[[inputs.modbus]]` in three styles (register, request, metric)
================  ==============================================================================================

Register maps in CSV, as manuals have them, are read by `busway.apps.simulator.csv_register_map`.

Where it is decided: which importer reads a file: `formats`. What is left out, and how that is reported: `imported`. How
a key of another program is understood: the file of that program (`home_assistant`, `modpoll`, `sunspec`, `telegraf`).
"""
