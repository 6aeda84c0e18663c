# SPDX-License-Identifier: Apache-2.0
"""Functions on the way of a gyro sample: ``python benchmarks/sample_walk.py [--list]``.

It counts the files and functions of the package between the bytes of a rates message and the update
of the coefficients, for samples that are learned from at once. A comprehension or lambda belongs to
its enclosing function.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import bench

import uav_ident_ros
from uav_ident_ros.bags.reading import Bag, Message
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.identifier import STRETCH_TIME, OnlineIdentifier
from uav_ident_ros.identification.samples import RATES_STREAM
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.messages.feed import Feed
from uav_ident_ros.messages.streams import STREAMS

FLIGHT = bench.ROOT / "bags" / "c172p"
LEARNING = 30.0
"""Time of flight before the count, s: all parts are then active."""

AIM = (12, 45)
"""Largest desired numbers of files and functions."""

Walk = dict[str, list[str]]
"""Functions of each file, in the order in which they are first called."""


def walked(work: Callable[[], object], found: Walk) -> None:
    """Call `work` and add the functions of the package that it calls."""
    root = Path(uav_ident_ros.__file__).parent

    def look(frame: FrameType, event: str, _: Any) -> None:
        file = Path(frame.f_code.co_filename)
        name = frame.f_code.co_qualname.split(".<locals>")[0]
        if event == "call" and file.is_relative_to(root) and not name.endswith(">"):
            functions = found.setdefault(file.relative_to(root).as_posix(), [])
            if name not in functions:
                functions.append(name)

    sys.setprofile(look)
    try:
        work()
    finally:
        sys.setprofile(None)


def follow(identifier: OnlineIdentifier, feed: Feed, message: Message) -> None:
    """Feed a message and compute the ticks that are then due."""
    feed.take(message.data, message.log_ns)
    list(identifier.advance())


def walk_of_a_sample() -> Walk:
    """Play the start of the bag; return the functions on the way of its samples."""
    walk: Walk = {}
    settings = Settings.from_values(load_parameters(FLIGHT / "identifier.yaml", "identifier"))
    identifier = OnlineIdentifier(settings)
    with Bag(FLIGHT) as bag:
        feeds = {
            topic: Feed(stream, identifier, bag.decoder(topic))
            for stream in STREAMS
            if (topic := f"/{stream.topic}") in bag.types
        }
        for message in bag.messages(feeds):
            feed, flown = feeds[message.topic], (message.log_ns - bag.start_ns) * 1e-9 - LEARNING
            if flown <= 0.0 or feed.stream.name != RATES_STREAM:
                follow(identifier, feed, message)
            elif flown <= STRETCH_TIME:
                walked(partial(follow, identifier, feed, message), walk)
            else:
                return walk
    raise SystemExit(f"'{FLIGHT}' is shorter than {LEARNING:g} s")


def main(arguments: list[str] | None = None) -> None:
    parser = bench.parser(__doc__)
    parser.add_argument("--list", action="store_true", help="name the functions, too")
    options = parser.parse_args(arguments)
    walk = walk_of_a_sample()
    for file, functions in walk.items():
        print(f"{len(functions):3} {file}{': ' + ', '.join(functions) if options.list else ''}")
    count = sum(map(len, walk.values()))
    print(f"{len(walk)} files, {count} functions (aim: {AIM[0]} and {AIM[1]})")


if __name__ == "__main__":
    main()
