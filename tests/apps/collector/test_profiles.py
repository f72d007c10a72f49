"""Every ready-made device is played, and a collector stores each of its points as the device holds it."""

from pathlib import Path

import pytest
from waiting import until

import busway
from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.config.profiles import DEVICES


async def test_every_point_of_every_ready_made_device_is_collected(tmp_path: Path) -> None:
    units = {name: number for number, name in enumerate(DEVICES, 1)}
    included = "".join(f'[[include]]\nfile = "device:{name}"\nunits = "{unit}"\n' for name, unit in units.items())
    simulation = Simulation(parse_declaration(included, "plant.toml"))
    simulation.tick(5.0)
    devices = {number: each.device for number, each in simulation.units.items()}
    async with busway.serve("tcp://127.0.0.1:0", units=devices) as server:
        file = tmp_path / "plant.toml"
        file.write_text(
            '[collector]\nstore = "data"\n[poll_class]\nall.period = 2.0\n'
            f'[[link]]\nname = "plant"\nurl = "{server.endpoints[0]}"\ntimeout = 10.0\n'
            + "".join(
                f'[[device]]\nname = "{name}"\nlink = "plant"\nunit = {unit}\nprofile = "device:{name}"\n'
                for name, unit in units.items()
            )
        )
        async with busway.collect(file) as collector:
            last = collector.values.last
            points = [
                (device.name, point.name)
                for device in collector.configuration.devices.values()
                for point in device.points
            ]
            await until(lambda: all(last(*each) is not None for each in points))
            status = {each.name: each for each in collector.status()}
    assert all(status[name].state == "polled" for name in DEVICES)
    names = {unit: name for name, unit in units.items()}
    table = busway.Store(tmp_path / "data").read()
    samples = {f"{each.device}/{each.point}": each for each in table}
    assert samples.keys() == {f"{device}/{point}" for device, point in points}
    compared = 0
    for key, played in simulation.points.items():
        unit, _, point = key.partition("/")
        sample = samples[f"{names[int(unit)]}/{point}"]
        if sample.quality.label == "good" and not isinstance(played.value, str):
            assert sample.value == pytest.approx(played.value), key
            compared += 1
    assert compared > 400
    bad = {each.device for each in samples.values() if each.quality.label == "bad"}
    assert bad <= set(tuple(DEVICES)[:5]), "profiles of real devices have a value for each point"
