"""The simulator: devices whose values change by themselves, built from files, and the plant of the demonstration.

================  ===================================================================================================
`builder`         Builds devices, points and behaviours from the units that a simulation file declares
`clone`           Clones a device: reads a live device and makes a simulation file that imitates it
`device_text`     Writes units as the text of a device file, which parses to the same units
`engine`          The engine of a simulation: which points change at each moment, in which order, and to which values
`fault_sections`  Adds faults to a simulation from `[[fault]]` sections and command-line words
`includes`        Loads a simulation file with all files that it includes; every error names its line in its own file
`plant`           The plant of the demonstration: a tank that consumers empty and a pump fills, a meter
`points`          Named points of a device for its application, read and written in their unit of measure
`register_map`    Imports register maps in CSV, as manuals and spreadsheets have them, as the points of a unit
`registers`       The position of a point in the memory of its device, and the encoding of its values there
`simulated`       A simulated point, its unit, and a change of its value
`simulation`      A running simulation: units whose points follow their behaviours
`state`           Saves the values of a simulation in a JSON file, so that it continues after a restart
`writes`          Reports Modbus writes to the points of a unit to the simulation
`behaviours`      Behaviours, which make simulated values change
================  ===================================================================================================
"""
