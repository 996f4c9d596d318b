"""Units of PX4's topics, as stated in its message definitions.

Source: PX4-Autopilot, msg/*.msg (main; these messages are unchanged since 1.8); suffixes follow its naming rule for
fields.
"""

from __future__ import annotations

from collections.abc import Iterable

from mkc_torch.recording.formats.base import UsualUnit

_BODY_RATE = dict.fromkeys("xyz", "rad/s")
_ACCELERATION = dict.fromkeys("xyz", "m/s²")

_TOPICS: dict[str, dict[str, str]] = {
    "sensor_mag": dict.fromkeys("xyz", "gauss") | {"temperature": "°C"},
    "sensor_gyro": _BODY_RATE | {"temperature": "°C"},
    "sensor_accel": _ACCELERATION | {"temperature": "°C"},
    "vehicle_angular_velocity": {f"xyz[{axis}]": "rad/s" for axis in range(3)},
    "vehicle_acceleration": {f"xyz[{axis}]": "m/s²" for axis in range(3)},
    "vehicle_attitude": {f"q[{part}]": "1" for part in range(4)},
    "vehicle_local_position": dict.fromkeys("xyz", "m") | {f"v{axis}": "m/s" for axis in "xyz"},
    "estimator_sensor_bias": {f"mag_bias[{axis}]": "gauss" for axis in range(3)}
    | {f"gyro_bias[{axis}]": "rad/s" for axis in range(3)}
    | {f"accel_bias[{axis}]": "m/s²" for axis in range(3)},
}
_TOPICS["vehicle_attitude_groundtruth"] = _TOPICS["vehicle_attitude"]

_SUFFIXES = {
    "magnetometer_ga": "gauss",
    "gyro_rad": "rad/s",
    "accelerometer_m_s2": "m/s²",
    "delta_angle": "rad",
    "delta_velocity": "m/s",
    "current_a": "A",
    "current_filtered_a": "A",
    "current_average_a": "A",
    "voltage_v": "V",
    "voltage_filtered_v": "V",
    "baro_temp_celcius": "°C",
    "latitude_deg": "°",
    "longitude_deg": "°",
    "altitude_msl_m": "m",
    "time_utc_usec": "us",
}


def px4_units(topic: str, columns: Iterable[str]) -> dict[str, str]:
    """The known units of a topic's columns.

    Args:
        topic: PX4 name of the topic, without the instance number.
        columns: names of its fields; arrays as ``q[0]``.

    Example:
        >>> px4_units("sensor_mag", ["timestamp", "x", "error_count"])
        {'timestamp': 'us', 'x': 'gauss'}
        >>> px4_units("vehicle_magnetometer", ["magnetometer_ga[2]", "device_id"])
        {'magnetometer_ga[2]': 'gauss'}
    """
    known = _TOPICS.get(topic, {})
    units: dict[str, str] = {}
    for column in columns:
        plain = column.partition("[")[0]
        if plain in ("timestamp", "timestamp_sample"):
            units[column] = UsualUnit("us")
        elif found := known.get(column) or _SUFFIXES.get(plain):
            units[column] = UsualUnit(found)
    return units
