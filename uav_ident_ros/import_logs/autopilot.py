# SPDX-License-Identifier: Apache-2.0
"""What the logs of all autopilots have in common: which messages to take, and what to say of it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.flight_log import Findings, ImportLogError, Mode, Setpoint
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.stamps import Stretches, coverage

ENOUGH_RATE = 20.0
"""Slowest rates the identifier works with, Hz. Commands slower than this are thinned out too much,
too: PX4 logs the motors at 10 Hz by default, while it commands them at several hundred."""

ENOUGH_COVERAGE = 0.9
"""Messages that cover less than this part of what the best cover are passed over: a topic that was
switched on for a part of the flight tells of that part alone."""

BOOT_TIME = "stamps are the autopilot's time since its start, not the time of day"
NO_FORCE = "there is no accelerometer at a useful rate: ay and az are zero"


def find_messages(
    log: Log,  # The log
    what: str,  # What they hold: ``rates`` and so on
    names: Collection[str],  # The kinds that can be read
    wanted: str | None,  # The only kind to look for
    instance: int,  # Which of several sensors or sets of commands
    # Name and instance to the messages, None if the log has none
    find: Callable[[str, int], Messages | None],
) -> dict[str, Messages]:
    """Find the messages asked for, or all kinds that would do, by name in the order of `names`.

    Raises
    ------
    ImportLogError
        If the kind asked for is none that can be read, or there are none.
    """
    if wanted is not None and wanted not in names:
        raise ImportLogError(
            f"log '{log.path}': '{wanted}' are no messages of {what}: there are {', '.join(names)}"
        )
    looked_for = [wanted] if wanted else names
    found = {
        name: messages for name in looked_for if (messages := find(name, instance)) is not None
    }
    if not found:
        which = f", instance {instance}" if instance else ""
        raise ImportLogError(
            f"log '{log.path}' has no {what} ({', '.join(looked_for)}{which}); it has "
            f"{log.contents()}"
        )
    return found


def choose(
    # Stamps, ns, and rate, Hz, by name, in the order of preference
    streams: Mapping[str, tuple[TimeArray, float]],
    flight: Stretches,  # Stretches of flight, ns; empty for the whole log
    findings: Findings,  # Gets what there is to say
    setting: str,  # The autopilot's parameter that says what is logged
    before_mixer: Collection[str] = (),  # Those of the names that are commands before the mixer
) -> str:
    """Name the messages to take: of those that are fast enough, the first that cover the flight.

    If none are, the fastest that cover it. What there is to choose from is said, and why
    what stands nearer to the sensor or the actuators is passed over.
    """
    every = [t_ns for t_ns, _ in streams.values()]
    whole_log = (min(int(t_ns.min()) for t_ns in every), max(int(t_ns.max()) for t_ns in every))
    shares = {name: coverage(t_ns, flight or [whole_log]) for name, (t_ns, _) in streams.items()}
    rates = {name: rate for name, (_, rate) in streams.items()}
    fast = [name for name in streams if rates[name] >= ENOUGH_RATE]
    able = fast or list(streams)
    most = max(shares[name] for name in able)
    whole = [name for name in able if shares[name] >= ENOUGH_COVERAGE * most]
    chosen = whole[0] if fast else max(whole, key=lambda name: rates[name])
    if len(streams) > 1:
        listed = [f"{n} at {rates[n]:.4g} Hz over {100.0 * shares[n]:.0f} %" for n in streams]
        findings.read.append(f"{chosen} is taken; of the flight there is {', '.join(listed)}")
    names = list(streams)
    for name in names[: names.index(chosen)]:
        reason = (
            f"is logged at {rates[name]:.3g} Hz only ({setting})"
            if rates[name] < ENOUGH_RATE and shares[name] >= ENOUGH_COVERAGE * most
            else f"covers {100.0 * shares[name]:.0f} % of the flight only"
        )
        loss = " from before the mixer, and knows nothing of saturation"
        tail = loss if chosen in before_mixer and name not in before_mixer else ""
        findings.lost.append(
            f"{name} {reason}; {chosen} is at {rates[chosen]:.3g} Hz{',' if tail else ''}{tail}"
        )
    if rates[chosen] < ENOUGH_RATE:
        findings.lost.append(
            f"{chosen} has {rates[chosen]:.3g} Hz only: {ENOUGH_RATE:g} Hz are needed ({setting})"
        )
    return chosen


def refuse_others(log: Log, known: Mapping[Any, str], found: Any, source: str) -> None:
    """Refuse a vehicle that is no aircraft.

    Raises
    ------
    ImportLogError
        If what was `found` at its source is a key of `known`.
    """
    if found in known:
        raise ImportLogError(
            f"log '{log.path}' is of {known[found]} ({source} {found}): the model is that of an "
            "aircraft's attitude"
        )


def read_mode(
    messages: Messages | None, field: str, names: Mapping[int, str], findings: Findings
) -> Mode | None:
    """Read the modes at each change; a number without a name is shown as it is."""
    if messages is None or field not in messages:
        return None
    numbers = messages.columns[field].astype(int)
    changed = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
    said = np.array([names.get(int(n), f"{field} {n}") for n in numbers[changed]])
    findings.read.append(f"mode: {messages.name}.{field}: {', '.join(dict.fromkeys(said))}")
    return Mode(messages.name, messages.stamp_ns[changed], said)


def read_setpoint(
    messages: Messages | None, fields: tuple[str, ...], unit: float, findings: Findings
) -> Setpoint | None:
    """Read the rates that were asked for, in body axes FRD; `unit` in rad/s."""
    if messages is None or not set(fields) <= set(messages.columns):
        return None
    findings.read.append(f"rates asked for: {messages.name}.{', '.join(fields)}")
    return Setpoint(messages.name, messages.stamp_ns, unit * messages.values(*fields))


def say_instances(sensor: str, instances: Collection[int], findings: Findings) -> None:
    """Say which instances of a sensor there are, if several."""
    if len(instances) > 1:
        findings.read.append(f"instances {list(instances)} of {sensor} (--rates-instance)")


def read_lever_arm(
    parameters: Mapping[str, float], prefix: str, findings: Findings
) -> tuple[float, float, float]:
    """Read the accelerometer's place, m, FRD, from the parameters ``prefixX``, ``Y`` and ``Z``."""
    x, y, z = (float(parameters.get(f"{prefix}{axis}", 0.0)) for axis in "XYZ")
    if any((x, y, z)):
        findings.read.append(f"accelerometer at {x:g} {y:g} {z:g} m ({prefix}X, Y, Z)")
    else:
        findings.assumed.append(f"the accelerometer is at the centre of gravity ({prefix}* 0)")
    return x, y, z


def median_in_flight(t_ns: TimeArray, values: FloatArray, flight: Stretches) -> float:
    """Return the median of finite values in some stretches, everywhere if there are none; or 0."""
    inside = np.zeros(len(t_ns), dtype=bool) if flight else np.ones(len(t_ns), dtype=bool)
    for start, end in flight:
        inside |= (start <= t_ns) & (t_ns <= end)
    chosen = values[inside & np.isfinite(values)]
    return float(np.median(chosen)) if len(chosen) else 0.0


def that_explain(parameters: Mapping[str, float], prefixes: tuple[str, ...]) -> dict[str, float]:
    """Return the parameters that begin with some letters, in the order of their names."""
    return {name: value for name, value in sorted(parameters.items()) if name.startswith(prefixes)}


def say_stretches(
    state: str, source: str, stretches: Collection[tuple[int, int]], findings: Findings
) -> None:
    """Say for how long the vehicle was in a state, armed and so on, and who says so."""
    seconds = sum(end - start for start, end in stretches) * 1e-9
    findings.read.append(f"{state} for {seconds:.1f} s in {len(stretches)} stretch(es) ({source})")


def say_changes(log: Log, prefixes: tuple[str, ...], findings: Findings) -> None:
    """Say which parameters that begin so became others in flight."""
    changes = [change for change in log.changes if change[1].startswith(prefixes)]
    for t, name, value in changes:
        findings.lost.append(f"{name} became {value:g} at {t:.1f} s: the first value is used")
