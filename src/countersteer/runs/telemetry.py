"""A car's reports as its pilot received them: from `telemetry.csv` back to readings."""

import numpy as np

from countersteer.errors import InputError
from countersteer.runs.files import Table
from countersteer.signals import Channel, Reading, Readings, flat, unflat


def readings_at(table: Table, channels: Readings, ticks: np.ndarray, dt: float) -> Readings:
    """The sensors' last reports at some ticks (n,); leaves have a leading axis of n.

    A row holds the readings that were new at its time. On board, that is the time of the reading.
    Raises `InputError` if a column of the car's sensors is missing.
    """
    rows = np.rint(table["time_s"] / dt).astype(np.int32)
    found = [_column(table, channel, rows, ticks) for channel in flat(channels)]
    return unflat(channels, found)


def _column(table: Table, channel: Channel, rows: np.ndarray, ticks: np.ndarray) -> Reading:
    """The readings of one channel."""
    for name in channel.columns:
        if name not in table:
            raise InputError(f"telemetry.csv: column {name} is missing")
    values = np.stack([table[name] for name in channel.columns], axis=1)
    new = np.nonzero(~np.isnan(values[:, 0]))[0]
    last = np.searchsorted(rows[new], ticks, side="right") - 1
    told = last >= 0
    # Before its first report, a sonar or lidar has no echo.
    silent = np.inf if channel.sensor.startswith(("sonar", "lidar")) else 0.0
    value = np.full((len(ticks), len(channel.columns)), silent)
    value[told] = values[new[last[told]]]
    tick = np.full(len(ticks), -1, np.int32)
    tick[told] = rows[new[last[told]]]
    return Reading(value if channel.shape else value[:, 0], tick)
