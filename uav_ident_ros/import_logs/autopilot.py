# SPDX-License-Identifier: Apache-2.0
"""What the logs of all autopilots have in common: which messages to take, and what to say of it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Protocol, TypeVar

from uav_ident_ros.import_logs.flight_log import Findings, ImportLogError

ENOUGH_RATE = 20.0
"""Slowest rates the identifier works with, Hz. Commands slower than this are thinned out too much,
too: PX4 logs the motors at 10 Hz by default, while it commands them at several hundred."""

BOOT_TIME = "stamps are the autopilot's time since its start, not the time of day"
NO_FORCE = "there is no accelerometer at a useful rate: ay and az are zero"


class Log(Protocol):
    """An opened log."""

    path: Path

    def contents(self) -> str:
        """List in one line what it has."""


class Messages(Protocol):
    """All messages of one kind."""

    @property
    def rate(self) -> float:
        """Messages per second."""


Found = TypeVar("Found", bound=Messages)


def find_messages(
    log: Log,
    what: str,
    names: Collection[str],
    wanted: str | None,
    instance: int,
    find: Callable[[str, int], Found | None],
) -> dict[str, Found]:
    """Find the messages asked for, or all kinds that would do, by name in the order of `names`.

    Parameters
    ----------
    log : Log
        The log.
    what : str
        What they hold: ``rates`` and so on.
    names : collection of str
        The kinds that can be read.
    wanted : str, optional
        The only kind to look for.
    instance : int
        Which of several sensors or sets of commands.
    find : callable
        Name and instance to the messages, None if the log has none.

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


def first_fast(rates: Mapping[str, float]) -> str:
    """Name the first that has enough messages per second, or else the fastest."""
    fast = [name for name, rate in rates.items() if rate >= ENOUGH_RATE]
    return fast[0] if fast else max(rates, key=lambda name: rates[name])


def choose_rates(found: Mapping[str, Messages], findings: Findings, setting: str) -> str:
    """Name the rates to take, and say if even they are too slow, and which `setting` helps."""
    name = first_fast({name: messages.rate for name, messages in found.items()})
    if found[name].rate < ENOUGH_RATE:
        findings.lost.append(
            f"{name} has {found[name].rate:.3g} Hz only: {ENOUGH_RATE:g} Hz are needed ({setting})"
        )
    return name


def say_other_rates(
    found: Mapping[str, Messages],
    name: str,
    findings: Findings,
    sensor: str,
    instances: Collection[int],
) -> None:
    """Say what else there was than the rates `name`, and which instances of a sensor."""
    others = [f"{n} at {m.rate:.4g} Hz" for n, m in found.items() if n != name]
    if others or len(instances) > 1:
        findings.read.append(
            f"other rates in the log, not used: {', '.join(others) or 'none'}"
            + (f"; instances {instances} of {sensor}" if len(instances) > 1 else "")
        )


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


def say_stretches(
    state: str, source: str, stretches: Collection[tuple[int, int]], findings: Findings
) -> None:
    """Say for how long the vehicle was in a state, armed and so on, and who says so."""
    seconds = sum(end - start for start, end in stretches) * 1e-9
    findings.read.append(f"{state} for {seconds:.1f} s in {len(stretches)} stretch(es) ({source})")


def say_changes(changes: Iterable[tuple[float, str, float]], findings: Findings) -> None:
    """Say which parameters, as time (s), name and value, became others in flight."""
    for t, name, value in changes:
        findings.lost.append(f"{name} became {value:g} at {t:.1f} s: the first value is used")
