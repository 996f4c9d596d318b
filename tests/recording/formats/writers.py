"""The same samples in each format, written by its specification or by its own writer."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Samples(NamedTuple):
    """A recording: ``time`` in whole µs, (N,); ``mag`` (N, 3) in gauss, float32 numbers."""

    time: np.ndarray
    mag: np.ndarray


def samples(count: int = 200, seed: int = 3) -> Samples:
    """A sensor that is turned: numbers that float32 holds exactly, as an autopilot's log has them."""
    draw = np.random.default_rng(seed)
    directions = draw.normal(size=(count, 3))
    field = 0.48 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    mag = field * [0.9, 1.0, 1.1] + [0.1, -0.05, 0.2] + draw.normal(scale=0.002, size=(count, 3))
    time = 5_000_000 + np.cumsum(draw.integers(9_000, 11_000, size=count))
    return Samples(time.astype(np.int64), mag.astype(np.float32).astype(np.float64))


def csv(path: Path, given: Samples) -> None:
    rows = [",".join(map(repr, row)) for row in zip(given.time.tolist(), *given.mag.T.tolist(), strict=True)]
    path.write_text("\n".join(["time,mag_x,mag_y,mag_z", *rows, ""]), encoding="utf-8")


def _ulog_message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(path: Path, given: Samples, instances: int = 1) -> None:
    """By docs.px4.io, "ULog File Format": header, flags, formats, subscriptions, data."""
    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", int(given.time[0]))]
    out.append(_ulog_message("B", bytes(40)))
    layout = "sensor_mag:uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;char[4] tag;"
    layout += "uint8_t[4] _padding0;"
    out.append(_ulog_message("F", layout.encode()))
    out.append(_ulog_message("I", bytes([len(b"char[3] sys_name")]) + b"char[3] sys_name" + b"PX4"))
    out += [_ulog_message("A", struct.pack("<BH", instance, instance) + b"sensor_mag") for instance in range(instances)]
    for time, mag in zip(given.time.tolist(), given.mag.tolist(), strict=True):
        for instance in range(instances):
            row = struct.pack("<HQQ3f4s", instance, time, time - 100, *(value + instance for value in mag), b"abc\0")
            out.append(_ulog_message("D", row))
    path.write_bytes(b"".join(out))


def _dataflash_format(kind: int, name: str, letters: str, columns: str) -> bytes:
    sizes = {"B": 1, "h": 2, "I": 4, "Q": 8, "f": 4, "d": 8, "b": 1, "N": 16, "Z": 64, "n": 4, "c": 2, "L": 4, "a": 64}
    length = 3 + sum(sizes[letter] for letter in letters)
    texts = name.encode(), letters.encode(), columns.encode()
    return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, length, *texts)


DATAFLASH_LETTERS = {
    "MAG": (130, "QBfff", "TimeUS,I,MagX,MagY,MagZ"),
    "BARO": (131, "Qc", "TimeUS,Temp"),
    "UNIT": (132, "QbZ", "TimeUS,Id,Label"),
    "MULT": (133, "Qbd", "TimeUS,Id,Mult"),
    "FMTU": (134, "QBNN", "TimeUS,FmtType,UnitIds,MultIds"),
}


def dataflash(path: Path, given: Samples, instances: int = 1, units: bool = True) -> None:
    """By libraries/AP_Logger/LogStructure.h: FMT of all messages, units, then data."""
    out = [_dataflash_format(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    out += [_dataflash_format(kind, name, *rest) for name, (kind, *rest) in DATAFLASH_LETTERS.items()]
    if units:
        for letter, label in (("s", "s"), ("G", "Gauss"), ("O", "degC"), ("#", "instance")):
            out.append(b"\xa3\x95\x84" + struct.pack("<Qb64s", 1, ord(letter), label.encode()))
        for letter, factor in (("F", 1e-6), ("C", 1e-3), ("-", 0.0), ("0", 1.0)):
            out.append(b"\xa3\x95\x85" + struct.pack("<Qbd", 1, ord(letter), factor))
        out.append(b"\xa3\x95\x86" + struct.pack("<QB16s16s", 1, 130, b"s#GGG", b"F-CCC"))
        out.append(b"\xa3\x95\x86" + struct.pack("<QB16s16s", 1, 131, b"sO", b"F0"))
    for time, mag in zip(given.time.tolist(), given.mag.tolist(), strict=True):
        for instance in range(instances):
            out.append(b"\xa3\x95\x82" + struct.pack("<QB3f", time, instance, *(value + instance for value in mag)))
        out.append(b"\xa3\x95\x83" + struct.pack("<Qh", time, 2531))
    path.write_bytes(b"".join(out))


def dataflash_text(path: Path, given: Samples) -> None:
    """The text form that ArduPilot's ground stations write, a message per line."""
    out = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    out += [
        f"FMT, {kind}, 23, {name}, {letters}, {names}" for name, (kind, letters, names) in DATAFLASH_LETTERS.items()
    ]
    out += [f"UNIT, 1, {ord(letter)}, {label}" for letter, label in (("s", "s"), ("G", "Gauss"), ("#", "instance"))]
    out += [f"MULT, 1, {ord(letter)}, {factor!r}" for letter, factor in (("F", 1e-6), ("C", 1e-3), ("-", 0.0))]
    out.append("FMTU, 1, 130, s#GGG, F-CCC")
    for time, mag in zip(given.time.tolist(), given.mag.tolist(), strict=True):
        out += [f"MAG, {time}, 0, " + ", ".join(map(repr, mag)), f"BARO, {time}, 25.31"]
    path.write_text("\n".join([*out, ""]), encoding="utf-8")


def _stamp(time: int) -> tuple[int, int]:
    return divmod(1000 * time, 1_000_000_000)


def _field_message(store: object, mag: list[float], time: int, ros1: bool) -> object:
    types = store.types  # type: ignore[attr-defined]
    seconds, nanoseconds = _stamp(time)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    more = {"seq": 0} if ros1 else {}
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="imu_link", **more)
    vector = types["geometry_msgs/msg/Vector3"](*mag)
    return types["sensor_msgs/msg/MagneticField"](header, vector, np.zeros(9))


MAGNETIC_FIELD = "sensor_msgs/msg/MagneticField"
TOPIC = "/imu/mag"


def rosbag1(path: Path, given: Samples, compression: str = "") -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer(path)
    if compression:
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    with writer:
        connection = writer.add_connection(TOPIC, MAGNETIC_FIELD, typestore=store)
        for time, mag in zip(given.time.tolist(), given.mag.tolist(), strict=True):
            data = store.serialize_ros1(_field_message(store, mag, time, True), MAGNETIC_FIELD)
            writer.write(connection, 1000 * time + 77, data)


def rosbag2(path: Path, given: Samples, storage: str = "SQLITE3", version: int = 9) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(path, version=version, storage_plugin=StoragePlugin[storage]) as writer:
        connection = writer.add_connection(TOPIC, MAGNETIC_FIELD, typestore=store)
        for time, mag in zip(given.time.tolist(), given.mag.tolist(), strict=True):
            data = store.serialize_cdr(_field_message(store, mag, time, False), MAGNETIC_FIELD)
            writer.write(connection, 1000 * time + 77, bytes(data))


def db3(path: Path, given: Samples) -> None:
    folder = path.with_suffix(".folder")
    rosbag2(folder, given)
    next(folder.glob("*.db3")).rename(path)


def mcap_of(path: Path, given: Samples, encoding: str, compression: str = "ZSTD", chunk: int = 2**20) -> None:
    """An MCAP file of ROS 1, ROS 2, JSON or Protocol Buffers."""
    from mcap.writer import CompressionType, Writer

    name, form, text, wire, encode = _ENCODINGS[encoding]()
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType[compression], chunk_size=chunk)
        writer.start()
        schema = writer.register_schema(name, form, text)
        channel = writer.register_channel(TOPIC, wire, schema)
        for time, mag in zip(given.time.tolist(), given.mag.tolist(), strict=True):
            writer.add_message(channel, 1000 * time + 77, encode(time, mag), 1000 * time)
        writer.finish()


Encoding = tuple[str, str, bytes, str, Callable[[int, list[float]], bytes]]


def _of_ros(ros1: bool) -> Encoding:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    text, _ = store.generate_msgdef(MAGNETIC_FIELD, ros_version=1 if ros1 else 2)
    write = store.serialize_ros1 if ros1 else store.serialize_cdr

    def encode(time: int, mag: list[float]) -> bytes:
        return bytes(write(_field_message(store, mag, time, ros1), MAGNETIC_FIELD))

    name = "sensor_msgs/MagneticField" if ros1 else MAGNETIC_FIELD
    return name, "ros1msg" if ros1 else "ros2msg", text.encode(), "ros1" if ros1 else "cdr", encode


def _of_json() -> Encoding:
    def encode(time: int, mag: list[float]) -> bytes:
        seconds, nanoseconds = _stamp(time)
        stamp = {"sec": seconds, "nsec": nanoseconds}
        return json.dumps({"header": {"stamp": stamp}, "magnetic_field": dict(zip("xyz", mag, strict=True))}).encode()

    return "MagneticField", "jsonschema", b'{"type": "object"}', "json", encode


def _of_protobuf() -> Encoding:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

    file = descriptor_pb2.FileDescriptorProto(name="field.proto", package="test", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    kinds = descriptor_pb2.FieldDescriptorProto
    vector = file.message_type.add(name="Vector")
    for number, axis in enumerate("xyz", start=1):
        vector.field.add(name=axis, number=number, type=kinds.TYPE_DOUBLE, label=kinds.LABEL_OPTIONAL)
    header = file.message_type.add(name="Header")
    header.field.add(
        name="stamp",
        number=1,
        type=kinds.TYPE_MESSAGE,
        label=kinds.LABEL_OPTIONAL,
        type_name=".google.protobuf.Timestamp",
    )
    field = file.message_type.add(name="Field")
    for number, (name, kind) in enumerate((("header", "Header"), ("magnetic_field", "Vector")), start=1):
        field.field.add(
            name=name, number=number, type=kinds.TYPE_MESSAGE, label=kinds.LABEL_OPTIONAL, type_name=f".test.{kind}"
        )
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(stamp)
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("test.Field"))

    def encode(time: int, mag: list[float]) -> bytes:
        message = kind()
        message.header.stamp.seconds, message.header.stamp.nanos = _stamp(time)
        message.magnetic_field.x, message.magnetic_field.y, message.magnetic_field.z = mag
        return message.SerializeToString()

    both = descriptor_pb2.FileDescriptorSet(file=[stamp, file])
    return "test.Field", "protobuf", both.SerializeToString(), "protobuf", encode


_ENCODINGS: dict[str, Callable[[], Encoding]] = {
    "ros1": lambda: _of_ros(True),
    "ros2": lambda: _of_ros(False),
    "json": _of_json,
    "protobuf": _of_protobuf,
}


def mcap(path: Path, given: Samples) -> None:
    mcap_of(path, given, "ros2")


def mat(path: Path, given: Samples, version: str = "5") -> None:
    from scipy.io import savemat

    savemat(path, {"log": {"t": given.time, "mag": given.mag, "rate": 100.0}}, format=version, do_compression=True)


def mat73(path: Path, given: Samples) -> None:
    """The format of MATLAB's save -v7.3: HDF5 after 512 bytes of text, structs as groups, arrays transposed."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("log")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for name, values in (
            ("t", given.time[None].astype(np.float64)),
            ("mag", given.mag.T),
            ("rate", np.array([[1e2]])),
        ):
            group[name] = values
            group[name].attrs["MATLAB_class"] = np.bytes_("double")
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    with path.open("r+b") as file:
        file.write(text)


def hdf5(path: Path, given: Samples) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        group = file.create_group("imu/magnetometer")
        group["time"] = given.time
        group["time"].attrs["units"] = "us"
        group["mag"] = given.mag
        group["mag"].attrs["units"] = "gauss"


def mdf(path: Path, given: Samples, version: str = "4.10") -> None:
    from asammdf import MDF, Signal

    # seconds are what MDF counts time in
    time = given.time / 1e6
    with MDF(version=version) as file:
        signals = [
            Signal(given.mag[:, place], time, name=f"mag_{axis}", unit="Gauss") for place, axis in enumerate("xyz")
        ]
        file.append(signals, acq_name="magnetometer", comment="magnetometer")
        file.save(path, overwrite=True)


WRITERS: dict[str, Callable[[Path, Samples], None]] = {
    ".ulg": ulog,
    ".bin": dataflash,
    ".log": dataflash_text,
    ".mcap": mcap,
    ".bag": rosbag1,
    ".db3": db3,
    ".mat": mat,
    ".h5": hdf5,
    ".mf4": mdf,
}
"""Writers by ending."""
