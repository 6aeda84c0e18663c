# SPDX-License-Identifier: Apache-2.0
"""What a bag is like: facts that explain a result, a line each."""

from collections.abc import Iterator

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.offline.inputs import candidates
from uav_ident_ros.offline.run import OfflineRun

MISSING_TIME = 1.0
"""Time without actuators at the beginning or the end that is worth a word, s."""


def notes_on(bag: Bag, run: OfflineRun) -> Iterator[str]:
    """Yield what there is to know about a bag that was replayed."""
    yield from bag.damage
    yield from _other_sensors(bag, run)
    yield from _mixed_frames(run)
    yield from _missing_actuators(run)


def _other_sensors(bag: Bag, run: OfflineRun) -> Iterator[str]:
    """Yield topics that might have been meant instead, or too."""
    taken = run.inputs.streams
    for stream in STREAMS:
        if not stream.setting:
            continue  # any JointState could be it: only the name tells
        others = [topic for topic in candidates(bag, stream.types) if topic not in taken.values()]
        if stream.name in taken and others:
            yield (
                f"{taken[stream.name]} was read; the bag also has {', '.join(others)}: "
                f"--topic {stream.topic}:={others[0]} reads that instead"
            )
        elif stream.name not in taken:
            for topic in others:
                if stream.topic in topic:  # the types alone, numbers among them, say little
                    yield f"{topic} was not read: --topic {stream.topic}:={topic} reads it"


def _mixed_frames(run: OfflineRun) -> Iterator[str]:
    """Yield that two sensors share a topic."""
    if len(run.intake.frame_ids) > 1:
        frames = ", ".join(f"'{frame}'" for frame in sorted(run.intake.frame_ids))
        yield (
            f"{run.inputs.streams['rates']} has messages of several frames, {frames}: if these are "
            "two sensors, record them on two topics"
        )


def _missing_actuators(run: OfflineRun) -> Iterator[str]:
    """Yield that actuators start late or stop early."""
    parts = list(run.stretches())
    if not any(len(part.inputs.t_ns) for part in parts):
        topic = run.inputs.streams["actuators"]
        yield f"{topic} has no messages that could be used: nothing is learned"
        return
    first, last = parts[0], parts[-1]
    if len(first.inputs.t_ns):
        late = int(first.inputs.t_ns[0] - first.t_ns[0]) * NS
        if late > MISSING_TIME:
            yield f"the actuators start {late:.1f} s after the Imu: nothing is learned before"
    if len(last.inputs.t_ns):
        early = int(last.t_ns[-1] - last.inputs.t_ns[-1]) * NS
        if early > MISSING_TIME:
            yield f"the actuators stop {early:.1f} s before the Imu: nothing is learned after"
