"""PX4's sensor messages: the fixed units of their columns, and the sensor type in the device id."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from mkc_torch.recording.formats.base import Table

PX4_UNITS: Mapping[str, str] = MappingProxyType({"time": "us", "mag": "gauss"})
"""Units of ``timestamp`` and ``sensor_mag`` (msg/SensorMag.msg of PX4: "time since system start (microseconds)", "in
Gauss")."""

_MESSAGE_COLUMNS = {"timestamp", "timestamp_sample", "device_id"}
"""Columns that together identify a sensor message of PX4."""

_MAGNETOMETERS = {0x01, *range(0x03, 0x0C), 0x0D, 0x0E, 0x0F, 0x43, 0x45, 0x62, 0x88, 0xE5}
"""Magnetometer types DRV_MAG_DEVTYPE_* of src/drivers/drv_sensor.h."""


def is_px4_message(names: Sequence[str]) -> bool:
    """Whether a table has the columns of a PX4 sensor message, as ``ulog2csv`` exports it.

    Example:
        >>> is_px4_message(["timestamp", "timestamp_sample", "device_id", "x", "y", "z"])
        True
    """
    return set(names) >= _MESSAGE_COLUMNS


def is_px4_magnetometer(table: Table) -> bool:
    """Whether all rows of a PX4 sensor message come from magnetometers, by the type in ``device_id``.

    Bits 16 to 23 of ``device_id`` are the type (src/lib/drivers/device/Device.hpp of PX4, ``DeviceStructure``).
    """
    if not is_px4_message(table.names):
        return False
    numbers = table.series[table.names.index("device_id")].unique().to_list()
    try:
        return bool(numbers) and all(int(number) >> 16 & 0xFF in _MAGNETOMETERS for number in numbers)
    except (TypeError, ValueError):
        return False
