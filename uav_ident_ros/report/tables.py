# SPDX-License-Identifier: Apache-2.0
"""The tables and cards of the report."""

import platform
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

import uav_ident_ros
from uav_ident_ros.files.meanings import AXIS_WORDS
from uav_ident_ros.files.parameter_file import written
from uav_ident_ros.identification.estimators.information import Information
from uav_ident_ros.identification.settings import declarations
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.offline.find import bag_files
from uav_ident_ros.offline.tables import Number, Row, Table, Words
from uav_ident_ros.report.diagrams import signals
from uav_ident_ros.report.flight import ReplayedFlight


def gates_table(lost: Mapping[str, float]) -> Table:
    """Return the share of the flight without learning, for each reason."""
    shares = {**lost, "learned": 1.0 - sum(lost.values())}
    rows = [Row(reason, [Number(100.0 * share, ".1f")]) for reason, share in shares.items()]
    return Table("Where the flight went, share of the ticks", ("reason", "[%]"), rows)


def correlations_table(flight: ReplayedFlight) -> Table:
    """Return the correlations of all signals with the inputs."""
    values = signals(flight)
    with np.errstate(invalid="ignore", divide="ignore"):  # NaN for constant signals
        found = np.corrcoef([*values.values()])[:, : len(INPUTS)]
    rows = [
        Row(name, [Number(value, ".2f", shaded=True) for value in line])
        for name, line in zip(values, found, strict=True)
    ]
    return Table("Correlation with the inputs", ("signal", *INPUTS), rows)


def coefficient_correlations(information: Information) -> Iterator[Table]:
    """Yield the correlation matrices of the estimated coefficients, row by row."""
    for row, (names, matrix) in information.correlations().items():
        rows = [
            Row(
                name, [Number(v, ".2f", shaded=True) for v in line[:i]] + [""] * (len(line) - 1 - i)
            )
            for i, (name, line) in enumerate(zip(names, matrix, strict=True))
            if i
        ]
        yield Table(f"Correlation of the coefficients of {row}", ("", *names[:-1]), rows)


def messages_table(summary: Mapping[str, Any]) -> Table:
    """Return the counts of received and dropped messages of every stream."""
    rows = []
    for stream, entry in summary["inputs"].items():
        dropped = ", ".join(f"{count} {why}" for why, count in entry["dropped"].items())
        cells = [Words(entry["topic"]), Words(entry["type"])]
        rows.append(Row(stream, [*cells, Number(entry["received"], "d"), Words(dropped or "none")]))
    head = ("stream", Words("topic"), Words("type"), "received", Words("dropped"))
    return Table("Messages", head, rows)


def settings_tables(summary: Mapping[str, Any]) -> Iterator[Table]:
    """Yield a table of settings that differ from their defaults, and a folded one of the others."""
    changed, others = [], []
    for setting in declarations():
        value = summary["settings"][setting.name]
        default = list(setting.default) if isinstance(setting.default, tuple) else setting.default
        cells = [Words(written(value)), Words(setting.unit), Words(written(default))]
        if value == default:
            others.append(Row(setting.name, cells[:2]))
        else:
            changed.append(Row(setting.name, cells))
    head = ("parameter", Words("value"), Words("unit"))
    if changed:
        yield Table("Settings that differ from the defaults", (*head, Words("default")), changed)
    folded = f"{len(others)} settings at their defaults"
    yield Table("Settings at their defaults", head, others, folded)


PACKAGES = ("numpy", "rosbags", "bokeh")
"""Packages that affect the numbers or the charts."""


def origin_tables(bag: Path) -> Iterator[Table]:
    """Yield the files of the bag with their hashes, and the versions of the software."""
    rows = [Row(name, [f"{size}", Words(digest)]) for name, size, digest in bag_files(bag)]
    yield Table("Bag", ("file", "bytes", Words("SHA-256")), rows)
    versions = {"uav_ident_ros": uav_ident_ros.__version__, "Python": platform.python_version()}
    versions |= {package: metadata.version(package) for package in PACKAGES}
    software = [Row(name, [version]) for name, version in versions.items()]
    yield Table("Software", ("package", "version"), software)


def card(fit: Mapping[str, Any], axis: str) -> tuple[str, Number, Number]:
    """Return an axis in words, its fit, and that of holding the rate."""
    model, hold = (Number(fit[kind][axis], ".1f") for kind in ("model", "hold"))
    return f"{AXIS_WORDS[f'{axis}dot']}, {axis}", model, hold
