"""The simulator: devices whose values change by themselves, built from files, and the plant of the demonstration.

==================  ===================================================================================================
`added_faults`      Adds faults to a simulation from `[[fault]]` sections and command-line words
`behaviours`        Behaviours, which make simulated values change
`builder`           Builds the devices, points and behaviours that a simulation file declares
`clone`             Clones a device: reads a live device and makes a simulation file that imitates it
`csv_register_map`  Imports register maps in CSV, as manuals and spreadsheets have them, as points of a unit
`demo_plant`        The plant of the demonstration, as three devices: a tank with pump and consumers, a meter
`device_text`       Writes units as the text of a device file; reading that text gives the same units
`engine`            The engine of a simulation: which points change at each moment, in which order, and to which values
`fault_times`       Reports when the faults of a simulation begin and end by their schedules
`includes`          Loads a simulation file with all files that it includes; every error names its line in its own file
`kept_values`       The values that a simulation keeps over restarts: which are saved, and which are taken up again
`point_encoding`    The place of a point in the memory of its device, and the encoding of its values there
`points`            Named points of a served device for the program that serves it
`recorded_tables`   Declares items that were read from a device, with their values, as the keys of a unit
`simulated`         Data of a running simulation: a simulated point, its unit, and a change of its value
`simulation`        A running simulation: units whose points follow their behaviours
`state_file`        The file with the saved values of a simulation: reads and replaces it
`write_watch`       Reports to a simulation which of its points a Modbus client has written
==================  ===================================================================================================

Where it is decided: which point changes when, and in which order: `engine`. How long a point keeps a written value
against its behaviour (``resume_after``): `engine` (``hold``); how a write by a client becomes a hold: `write_watch`,
`simulation`. Where a point is in memory, and how it is encoded: `point_encoding`. The value at a moment: `behaviours`.
When values are saved (``keep_every``, and at the end): `simulation`; which values, and which of them are taken up
again: `kept_values`; whether there is a state file, and where (``keep``): `includes`; what becomes of a damaged one:
`state_file`. Which faults are added, and when they begin: `added_faults`, `fault_times`. What a clone leaves out:
`clone`. Columns of a register map: `csv_register_map`. Which parameters a fault has: `busway.faults.profiles`.
"""
