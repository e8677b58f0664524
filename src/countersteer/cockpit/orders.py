"""What an order of the page makes of a setting."""

import dataclasses
from typing import Any

from countersteer.car.files import load_car
from countersteer.cockpit import messages as m
from countersteer.cockpit.setting import Setting, declared, refuse_unknown, sensor_states
from countersteer.errors import InputError


def wanted(setting: Setting, message: Any) -> Setting:
    """The setting after a message. Raises `InputError` for a name or a value that is wrong."""
    if isinstance(message, m.Gyro):
        return dataclasses.replace(setting, gyro=message.on, strength=message.strength)
    if isinstance(message, m.Paint):
        return dataclasses.replace(setting, patches=tuple(message.patches))
    if isinstance(message, m.Parameter):
        return _with_parameter(setting, message)
    if isinstance(message, m.Sensor):
        return _with_sensor(setting, message)
    raise InputError(f"{m.kind_of(type(message))}: is no order")


def _with_parameter(setting: Setting, message: m.Parameter) -> Setting:
    known = declared(setting.car)
    refuse_unknown(message.path, known, "parameter")
    values = {path: value for path, value in setting.parameters.items() if path != message.path}
    if message.value is not None:
        low, high = known[message.path]["low"], known[message.path]["high"]
        if not low <= message.value <= high:
            raise InputError(f"{message.path} must be in [{low:g}, {high:g}]")
        values[message.path] = message.value
    return dataclasses.replace(setting, parameters=values)


def _with_sensor(setting: Setting, message: m.Sensor) -> Setting:
    states = sensor_states(load_car(setting.car), setting.link)
    refuse_unknown(message.name, states, "sensor")
    if message.state not in states[message.name]:
        raise InputError(f"{message.name} can be {', '.join(states[message.name])}")
    others = {name: state for name, state in setting.sensors.items() if name != message.name}
    if message.state != "on":
        others[message.name] = message.state
    return dataclasses.replace(setting, sensors=others)


def set_up(setting: Setting, message: m.SetUp, course: Any | None) -> Setting:
    """The setting of a new drive. `course` is that of the message's name; None keeps it.

    A car's parameters, and the states of sensors, are of the car before: another car has its own.
    """
    changed = {
        "driver": message.driver,
        "estimate": message.estimate,
        "link": message.link,
        "car": message.car,
        "laps": message.laps,
    }
    fields: dict[str, Any] = {name: value for name, value in changed.items() if value}
    if message.seed >= 0:
        fields["seed"] = message.seed
    if message.battery >= 0:
        fields["battery"] = message.battery
    if course is not None:
        fields |= {"course": course, "course_name": message.course, "patches": ()}
    if (message.car and message.car != setting.car) or (
        message.link and message.link != setting.link
    ):
        fields |= {"sensors": {}}
    if message.car and message.car != setting.car:
        fields |= {"parameters": {}}
    return dataclasses.replace(setting, **fields)
