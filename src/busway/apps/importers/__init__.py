"""Importers: convert device descriptions of other programs into device files, and report what could not be carried
over.

===================  =====================================================================
`imported`           what an importer finds, checked and written as a device file
`formats`            which importer reads a file
`telegraf`           ``inputs.modbus`` of Telegraf, TOML
`home_assistant`     ``modbus:`` of Home Assistant, YAML
`modpoll`            the CSV of modpoll
`sunspec`            SunSpec models, JSON
`plain_yaml`         the part of YAML that such files need, with the line of each key
===================  =====================================================================

Register maps in CSV, as manuals have them, are read by `busway.apps.simulator.register_map`.
"""
