# SPDX-License-Identifier: Apache-2.0
"""Parts of the committed bags, modified on request, and replays of them."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from repository import ROOT

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.bags.writing import BagWriter, jazzy_types
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.offline import main

BAGS = ROOT / "bags"
IMU, ACTUATORS = "/imu/data", "/actuators"
SECOND_NS = 1_000_000_000
START_NS = 1_700_000_000 * SECOND_NS
"""Start of the flight in every committed bag, ns."""

PARAMETERS = BAGS / "multisine" / "identifier.yaml"

Entry = tuple[str, int, Any]
"""Topic, log time (ns) and message."""


def excerpt(
    target: Path,
    seconds: float,
    source: str = "multisine",
    change: Callable[[str, int, Any], list[Entry] | None] | None = None,
    begin: float = 0.0,
) -> Path:
    """Copy a part of a committed bag; `change` edits each message or returns its replacements."""
    with Bag(BAGS / source) as bag, BagWriter(target) as writer:
        decoders = {topic: bag.decoder(topic) for topic in (IMU, ACTUATORS)}
        announced: set[str] = set()
        first_ns = START_NS + round(begin * SECOND_NS)
        for topic, log_ns, data in bag.messages([IMU, ACTUATORS]):
            if log_ns < first_ns:
                continue
            if log_ns > first_ns + round(seconds * SECOND_NS):
                break
            entries: list[Entry] = [(topic, log_ns, data)]
            if change is not None:
                message = decoders[topic](data)
                changed = change(topic, log_ns, message)
                entries = [(topic, log_ns, message)] if changed is None else changed
            for name, at, written in entries:
                if name not in announced:
                    announced.add(name)
                    writer.topic(name, getattr(written, "__msgtype__", bag.types[topic]))
                writer.write(name, at, written)
    return target


def written(
    path: Path, types: Mapping[str, str], messages: Iterable[Sequence[Any]], **options: Any
) -> Path:
    """Write a bag of messages: topic, log time (ns), and message or bytes."""
    with BagWriter(path, **options) as bag:
        for topic, msgtype in types.items():
            bag.topic(topic, msgtype)
        for message in messages:
            bag.write(*message)
    return path


def one_folder(folder: Path, *bags: Path) -> Path:
    """Move the files of some bags into a folder without metadata."""
    folder.mkdir()
    for bag in bags:
        (bag / f"{bag.name}.mcap").rename(folder / f"{bag.name}.mcap")
    return folder


def decoded(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return log times and messages of a bag, by topic."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with Bag(bag) as opened:
        decoders = {topic: opened.decoder(topic) for topic in opened.types}
        for topic, log_ns, data in opened.messages(opened.types):
            found.setdefault(topic, []).append((log_ns, decoders[topic](data)))
    return found


def parameters(name: str = "multisine", **changes: Any) -> dict[str, Any]:
    """Return the parameters beside a committed bag, with changes (``__`` for the dots)."""
    values = load_parameters(BAGS / name / "identifier.yaml", "identifier")
    return values | {key.replace("__", "."): value for key, value in changes.items()}


def parameter_file(path: Path, **values: Any) -> Path:
    """Write a file of parameters for every node; keywords with ``__`` for the dots."""
    named = {key.replace("__", "."): value for key, value in values.items()}
    path.write_text(yaml.safe_dump({"/**": {"ros__parameters": named}}), encoding="utf-8")
    return path


def replay(bag: Path, output: Path, *more: str, by: str | Path = "multisine") -> int:
    """Run `replay` with a committed bag's parameters or those of a file; return its status."""
    file = BAGS / by / "identifier.yaml" if isinstance(by, str) else by
    return main([str(bag), "--params-file", str(file), "--output", str(output), *more])


def summary(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


TYPES = {IMU: "sensor_msgs/msg/Imu", ACTUATORS: "sensor_msgs/msg/JointState"}

CHUNK = 50_000
"""Size of the chunks, bytes: about half a second of the flight."""


def rewritten(
    target: Path,
    *,
    compression: CompressionType = CompressionType.NONE,
    use_chunking: bool = True,
    seconds: float,
) -> Path:
    """Write the start of a flight in a recorder's format: small chunks, with checksums."""
    with Bag(BAGS / "multisine") as bag, target.open("wb") as file:
        writer = McapWriter(
            file, chunk_size=CHUNK, compression=compression, use_chunking=use_chunking
        )
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, name in TYPES.items():
            definition = jazzy_types().generate_msgdef(name)[0].encode()
            schema = writer.register_schema(name, "ros2msg", definition)
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for topic, log_ns, data in bag.messages(TYPES):
            if log_ns <= START_NS + seconds * 1e9:
                writer.add_message(channels[topic], log_ns, data, log_ns)
        writer.finish()
    return target
