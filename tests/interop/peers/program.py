"""Runs a published program that uses pymodbus or minimalmodbus: over the original, or over busway's modules.

usage: program.py ORIGINAL|BUSWAY LIBRARY PROGRAM ARGUMENTS…

PROGRAM is a module that is run as a command, or one of the functions below, which use a library as its users do and
print what they got. The programs themselves are installed as published; nothing of them is changed.
"""

import runpy
import sys


def sdm_modbus(port: str) -> None:
    """All registers of an energy meter, one alone, and a write."""
    import sdm_modbus

    meter = sdm_modbus.SDM630(host="127.0.0.1", port=int(port), timeout=5, unit=1)
    print(meter, meter.connected())
    show(meter.read_all(sdm_modbus.registerType.INPUT))
    show(meter.read_all(sdm_modbus.registerType.HOLDING))
    show({"frequency": meter.read("frequency")})
    print(meter.write("demand_time", 15.0).isError(), meter.read("demand_time"))
    meter.disconnect()
    print(meter.connected())


def sdm_modbus_rtu(path: str) -> None:
    """All registers of an energy meter on a serial line."""
    import sdm_modbus

    meter = sdm_modbus.SDM630(device=path, stopbits=1, parity="N", baud=115_200, timeout=2, unit=1)
    print(meter.connected())
    show(meter.read_all(sdm_modbus.registerType.INPUT))
    show(meter.read_all(sdm_modbus.registerType.HOLDING))
    meter.disconnect()
    print(meter.connected())


def solaredge_modbus(port: str) -> None:
    """All values of an inverter, and a write."""
    import solaredge_modbus

    inverter = solaredge_modbus.Inverter(host="127.0.0.1", port=int(port), timeout=5, unit=1)
    print(inverter, inverter.connected())
    show(inverter.read_all())
    print(inverter.write("active_power_limit", 55).isError(), inverter.read("active_power_limit"))
    inverter.disconnect()


def alfen_eve_modbus_tcp(port: str) -> None:
    """All values of a charging station, some of units that do not exist."""
    import alfen_eve_modbus_tcp as alfen

    station = alfen.CarCharger(host="127.0.0.1", port=int(port), timeout=5)
    print(station.connected())
    show(station.read_all(alfen.registerType.HOLDING))
    station.disconnect()
    print(station.connected())


def epevermodbus(path: str) -> None:
    """All that a charge controller says of itself, and two writes; words that it lacks are errors."""
    from epevermodbus.driver import EpeverChargeController

    controller = EpeverChargeController(path, 1)
    for name in sorted(one for one in dir(controller) if one.startswith(("get_", "is_"))):
        try:
            print(name, getattr(controller, name)())
        except (KeyError, ValueError) as error:
            print(name, type(error).__name__, error)
    controller.set_battery_capacity(120)
    controller.set_temperature_compensation_coefficient(3)
    print(controller.get_battery_capacity(), controller.get_temperature_compensation_coefficient())


def show(values: dict[str, object]) -> None:
    """One line for each value."""
    for name, value in sorted(values.items()):
        print(name, repr(value))


def main() -> None:
    """Run the program over the library that the first argument says."""
    _, over, library, program, *arguments = sys.argv
    if over == "BUSWAY":
        import busway.compat

        busway.compat.install(library)
    if program in globals():
        globals()[program](*arguments)
    else:
        sys.argv = [program, *arguments]
        runpy.run_module(program, run_name="__main__")


main()
