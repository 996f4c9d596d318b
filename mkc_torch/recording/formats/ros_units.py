"""Units of ROS messages, as stated in REP 103 and in the comments of the .msg files."""

from __future__ import annotations

from collections.abc import Mapping


def _axes(name: str, unit: str) -> dict[str, str]:
    return {f"{name}.{axis}": unit for axis in "xyz"}


ROS_UNITS: Mapping[str, Mapping[str, str]] = {
    "sensor_msgs/msg/MagneticField": _axes("magnetic_field", "T"),
    "sensor_msgs/msg/Imu": _axes("angular_velocity", "rad/s") | _axes("linear_acceleration", "m/s²"),
    "sensor_msgs/msg/Temperature": {"temperature": "°C"},
    "sensor_msgs/msg/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/msg/BatteryState": {"voltage": "V", "current": "A"},
    "sensor_msgs/msg/NavSatFix": {"latitude": "°", "longitude": "°", "altitude": "m"},
    "geometry_msgs/msg/Quaternion": dict.fromkeys("xyzw", "1"),
    "geometry_msgs/msg/Pose": _axes("position", "m"),
    "geometry_msgs/msg/Transform": _axes("translation", "m"),
    "geometry_msgs/msg/Twist": _axes("linear", "m/s") | _axes("angular", "rad/s"),
    "geometry_msgs/msg/Accel": _axes("linear", "m/s²") | _axes("angular", "rad/s²"),
    "geometry_msgs/msg/Wrench": _axes("force", "N") | _axes("torque", "N·m"),
    "geometry_msgs/msg/PointStamped": _axes("point", "m"),
}
"""Message type to the units of its fields, also for nested messages of that type."""
