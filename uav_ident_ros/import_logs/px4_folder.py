# SPDX-License-Identifier: Apache-2.0
"""A PX4 log as ulog2csv leaves it: a folder with a table for each topic and instance."""

import re
from collections.abc import Collection
from pathlib import Path

import numpy as np

from uav_ident_ros.import_logs.flight_log import ImportLogError
from uav_ident_ros.import_logs.log import Column, Log

TABLE = re.compile(r"(?P<log>.+?)_(?P<topic>{topics})_(?P<instance>\d+)\.csv")
"""How ulog2csv names its files."""

PARAMETERS = re.compile(r".*param(s|eters)?\.(csv|txt)")
"""What ulog_params writes: lines of a name and a value."""


def read_folder(path: Path, topics: Collection[str]) -> Log:
    """Read the tables of some topics, and the parameters if they are there.

    Raises
    ------
    ImportLogError
        If there is none of them, there are those of several logs, or one cannot be read.
    """
    pattern = re.compile(TABLE.pattern.replace("{topics}", "|".join(map(re.escape, topics))))
    found = {file: match for file in sorted(path.iterdir())
             if (match := pattern.fullmatch(file.name))}  # fmt: skip
    logs = sorted({match["log"] for match in found.values()})
    if len(logs) != 1:
        raise ImportLogError(
            f"folder '{path}' has the tables of several logs, {', '.join(logs)}: give each its own"
            if logs
            else f"folder '{path}' has no table of ulog2csv, as LOG_sensor_combined_0.csv"
        )
    log = Log(path, "PX4, by ulog2csv")
    for file, match in found.items():
        columns = _table(file)
        if len(columns["timestamp"]):
            log.add(match["topic"], int(match["instance"]), columns)
    for file in path.iterdir():
        if PARAMETERS.fullmatch(file.name.lower()):
            log.parameters.update(_parameters(file))
    if not log.parameters:
        log.findings.doubt(
            "the tables say nothing of the parameters: ulog_params LOG.ulg PARAMS.csv writes them"
        )
    return log


def _table(file: Path) -> dict[str, Column]:
    try:
        with file.open(encoding="utf-8") as text:
            names = text.readline().strip().split(",")
            values = np.loadtxt(text, delimiter=",", ndmin=2).reshape(-1, len(names))
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ImportLogError(f"table '{file}' cannot be read: {reason}") from None
    if "timestamp" not in names:
        raise ImportLogError(f"table '{file}' has no column 'timestamp'")
    return dict(zip(names, values.T, strict=True))


def _parameters(file: Path) -> dict[str, float]:
    """Return the parameters of lines such as ``CA_AIRFRAME,1``."""
    found = re.findall(
        r"(?m)^\s*(\w+)[,:\s]+([-+0-9.eE]+)\s*(?:,|$)", file.read_text("utf-8", errors="replace")
    )
    result = {}
    for name, value in found:
        try:
            result[name] = float(value)
        except ValueError:
            continue
    return result
