"""Convert recordings of slipguard (MCAP) to a rosbag2 that `ros2 bag` and RViz read. Needs no ROS.

pip install 'slipguard-ros[rosbag]'
slipguard_to_rosbag recording.mcap bag
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

VERSION = 8
"""Of the bag's metadata: read by Humble and every newer version."""
COMPRESSED, TEXT, LOG = "sensor_msgs/msg/CompressedImage", "std_msgs/msg/String", "rcl_interfaces/msg/Log"
JOINTS, POSE = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseWithCovarianceStamped"
LOG_LEVELS = {2: 20, 3: 30, 4: 40}
"""Foxglove's INFO, WARNING, ERROR to those of rcl_interfaces."""


class BagWriter:
    """Writes messages of the types above."""

    def __init__(self, writer: Writer) -> None:
        self._types = get_typestore(Stores.ROS2_HUMBLE)
        self._writer = writer
        self._connections: dict[str, Any] = {}
        self.written = 0

    def make(self, kind: str, **fields: Any) -> Any:
        """Return a message of a type such as `std_msgs/msg/Header`."""
        return self._types.types[kind](**fields)

    def header(self, at_ns: int, frame: str) -> Any:
        """Return a header with a time in nanoseconds since 1970."""
        stamp = self.make("builtin_interfaces/msg/Time", sec=at_ns // 10**9, nanosec=at_ns % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=f"slipguard_{frame}")

    def add(self, topic: str, kind: str, at_ns: int, **fields: Any) -> None:
        """Write one message."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._types)
        data = self._types.serialize_cdr(self.make(kind, **fields), kind)
        self._writer.write(self._connections[topic], at_ns, data)
        self.written += 1


def convert(recording: Path, folder: Path) -> tuple[int, str | None]:
    """Convert one recording to a new bag.

    Returns:
        Number of messages, and why reading ended early: the newest file of a running daemon is not complete.

    Raises:
        FileExistsError: if the folder exists.
        ValueError: if the file is not a recording of slipguard.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists; choose a new folder")
    with recording.open("rb") as file:
        messages = _read_messages(file)
        first = next(messages, None)
        if first is None or first[0].topic != "/memory":
            raise ValueError(f"{recording} is not a recording of slipguard")
        with Writer(folder, version=VERSION, storage_plugin=StoragePlugin.SQLITE3) as writer:
            bag = BagWriter(writer)
            try:
                for channel, schema, message in itertools.chain((first,), messages):
                    if channel.message_encoding == "json":
                        _add_json(bag, channel.topic, message.log_time, message.data.decode())
                    elif schema.name in _PROTOBUF:
                        decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
                        _PROTOBUF[schema.name](bag, channel.topic, message.log_time, decode(message.data))
            except (McapError, EOFError, RuntimeError) as error:
                return bag.written, str(error) or type(error).__name__
            return bag.written, None


def _read_messages(file: IO[bytes]) -> Iterator[tuple[Channel, Schema, Message]]:
    """Yield the messages in the order written; also of a file without an index."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in StreamReader(file).records:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels[record.channel_id]
            yield channel, schemas[channel.schema_id], record


def _add_json(bag: BagWriter, topic: str, at_ns: int, text: str) -> None:
    bag.add(f"/slipguard{topic}", TEXT, at_ns, data=text)
    if topic == "/tick":
        _add_readings(bag, at_ns, json.loads(text)["observation"])


def _add_readings(bag: BagWriter, at_ns: int, observation: dict[str, Any]) -> None:
    """Write rotation and jaws of a control step as the node publishes them."""
    header, gripper = bag.header(at_ns, "grasp"), observation.get("gripper")
    rotation = observation.get("fused")
    if gripper:
        none = np.zeros(0)
        position, effort = np.array([gripper["width_mm"] / 1000.0]), np.array([float(gripper["force_n"])])
        fields = {"name": ["slipguard_jaws"], "position": position, "velocity": none, "effort": effort}
        bag.add("/slipguard/joint_states", JOINTS, at_ns, header=header, **fields)
    if rotation and rotation["rotation_deg"] is not None:
        covariance, half_rad = np.zeros(36), math.radians(rotation["rotation_deg"]) / 2.0
        covariance[[0, 7, 14, 21, 28]] = -1.0  # not measured
        covariance[35] = math.radians(rotation["sigma_deg"]) ** 2
        sine, cosine = math.sin(half_rad), math.cos(half_rad)
        orientation = bag.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=sine, w=cosine)
        origin = bag.make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0)
        pose = bag.make("geometry_msgs/msg/Pose", position=origin, orientation=orientation)
        with_covariance = bag.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
        bag.add("/slipguard/rotation", POSE, at_ns, header=header, pose=with_covariance)


def _add_image(bag: BagWriter, topic: str, at_ns: int, image: Any) -> None:
    """`/left/image` becomes `/slipguard/left/image_raw/compressed`, as image_transport names it; masks likewise."""
    name = topic.replace("/image", "/image_raw")
    fields = {"format": image.format, "data": np.frombuffer(image.data, np.uint8)}
    header = bag.header(at_ns, image.frame_id)
    bag.add(f"/slipguard{name}/compressed", COMPRESSED, at_ns, header=header, **fields)


def _add_log(bag: BagWriter, topic: str, at_ns: int, log: Any) -> None:
    stamp = bag.header(at_ns, "").stamp
    fields = {"level": LOG_LEVELS.get(log.level, 20), "name": log.name, "msg": log.message}
    bag.add("/rosout", LOG, at_ns, stamp=stamp, file="", function="", line=0, **fields)


_PROTOBUF: dict[str, Callable[[BagWriter, str, int, Any], None]] = {
    "foxglove.CompressedImage": _add_image,
    "foxglove.Log": _add_log,
}


def main() -> int:
    """Convert the file of the command line; return the exit status."""
    parser = argparse.ArgumentParser(prog="slipguard_to_rosbag", description="Convert a recording to a rosbag2.")
    parser.add_argument("recording", type=Path, help="an .mcap file of slipguard")
    parser.add_argument("bag", type=Path, help="the folder of the new bag")
    given = parser.parse_args()
    try:
        written, ended_early = convert(given.recording, given.bag)
    except (OSError, ValueError, McapError) as error:
        print(f"slipguard_to_rosbag: {error}", file=sys.stderr)
        return 1
    if ended_early:
        print(f"the recording is not complete: {ended_early}", file=sys.stderr)
    print(f"{written} messages written to {given.bag}; play them with `ros2 bag play {given.bag}`")
    return 0


if __name__ == "__main__":
    sys.exit(main())
