# SPDX-License-Identifier: Apache-2.0
"""An ArduPilot dataflash log file, opened with pymavlink: messages as arrays, parameters."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.flight_log import NS_PER_US, Column, ImportLogError
from uav_ident_ros.import_logs.stamps import rate

MAGIC = b"\xa3\x95\x80"
"""First bytes of every dataflash log: the header of a FMT message."""

INSTANCE_FIELD = "I"


class Messages:
    """All messages of one type and instance.

    Parameters
    ----------
    name : str
        Type, with ``[i]`` behind it for an instance beyond the first.
    columns : dict
        Array of values by field name.
    """

    def __init__(self, name: str, columns: dict[str, Column]) -> None:
        self.name = name
        self.columns = columns

    def __contains__(self, field: str) -> bool:
        """Whether they have such a field."""
        return field in self.columns

    @property
    def stamp_ns(self) -> TimeArray:
        """When they were logged, ns since the start of the autopilot."""
        return self._ns("TimeUS")

    @property
    def sample_ns(self) -> TimeArray:
        """When what they hold was sampled, ns; when it was logged if that is not said."""
        return self._ns("SampleUS" if "SampleUS" in self else "TimeUS")

    def _ns(self, field: str) -> TimeArray:
        return np.asarray(self.columns[field], dtype=np.int64) * NS_PER_US

    @property
    def rate(self) -> float:
        """Messages per second."""
        return rate(self.sample_ns)

    def values(self, *fields: str) -> FloatArray:
        """Values of some fields, shape (k, number of fields)."""
        return np.column_stack([self.columns[field] for field in fields]).astype(float)


class DataflashLog:
    """An ArduPilot log in memory: some types of its messages.

    Parameters
    ----------
    path : Path
        Dataflash file.
    types : tuple of str
        The types to read.

    Attributes
    ----------
    parameters : dict
        Parameters as first logged, by name.
    changes : list of tuple
        Time (s), name and value of every parameter that changed afterwards.
    texts : list of str
        The MSG messages.
    damage : list of str
        What could not be read.

    Raises
    ------
    ImportLogError
        If pymavlink is missing or the file is none that it can read.
    """

    def __init__(self, path: Path, types: tuple[str, ...]) -> None:
        self.path = path
        self.parameters: dict[str, float] = {}
        self.changes: list[tuple[float, str, float]] = []
        self.texts: list[str] = []
        self.damage: list[str] = []
        self.end_ns = 0
        self._types: list[str] = []
        self._rows: dict[tuple[str, int], list[list[float]]] = {}
        self._fields: dict[str, list[str]] = {}
        self._read(types)

    def messages(self, name: str, instance: int = 0) -> Messages | None:
        """Return the messages of a type and instance, if there are any."""
        rows = self._rows.get((name, instance))
        if not rows:
            return None
        columns = dict(zip(self._fields[name], np.array(rows).T, strict=True))
        if "TimeUS" not in columns:
            return None
        return Messages(f"{name}[{instance}]" if instance else name, columns)

    def instances(self, name: str) -> list[int]:
        """Instances of a type that have messages."""
        return sorted(i for n, i in self._rows if n == name)

    def contents(self) -> str:
        """List the message types in one line."""
        return ", ".join(self._types) or "no messages at all"

    def _read(self, types: tuple[str, ...]) -> None:
        """Run through the file once."""
        reader_class = _reader_class(self.path)
        said = io.StringIO()
        try:
            # The reader reports damage on both streams.
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
                reader = reader_class(str(self.path), zero_time_base=True)
                try:
                    self._types = sorted(
                        name for name, number in reader.name_to_id.items() if reader.counts[number]
                    )
                    self._collect(reader, types)
                    if _ends_early(reader):
                        self.damage.append("the file is cut off at its end: what is there was read")
                finally:
                    reader.close()
        except OSError as error:
            raise ImportLogError(
                f"log '{self.path}' cannot be read: {error.strerror or error}"
            ) from None
        except ImportLogError:
            raise
        except Exception as error:
            # Damaged bytes make a parser fail in many ways.
            raise ImportLogError(
                f"log '{self.path}' is no readable dataflash log: {error}"
            ) from error
        if complaints := said.getvalue().splitlines():
            self.damage.append(
                f"the file is damaged, pymavlink left out what it could not read: {complaints[0]}"
                + (f", and {len(complaints) - 1} more" if len(complaints) > 1 else "")
            )

    def _collect(self, reader: Any, types: tuple[str, ...]) -> None:
        wanted = {*types, "PARM", "MSG"}
        while (message := reader.recv_match(type=wanted, strict=True)) is not None:
            name = message.get_type()
            if name == "PARM":
                self._take_parameter(message)
            elif name == "MSG":
                self.texts.append(str(message.Message))
            elif name in types:
                fields = self._fields.setdefault(name, list(message.get_fieldnames()))
                row = [_number(getattr(message, field)) for field in fields]
                instance = int(getattr(message, INSTANCE_FIELD, 0))
                self._rows.setdefault((name, instance), []).append(row)
                self.end_ns = max(self.end_ns, int(getattr(message, "TimeUS", 0)) * NS_PER_US)

    def _take_parameter(self, message: Any) -> None:
        name, value = str(message.Name), float(message.Value)
        before = self.parameters.setdefault(name, value)
        if before != value:
            self.changes.append((getattr(message, "TimeUS", 0) * 1e-6, name, value))


def _ends_early(reader: Any) -> bool:
    """Whether the last message of some type reaches beyond the end of the file."""
    return any(
        offsets[-1] + reader.formats[number].len > reader.data_len
        for number, offsets in enumerate(reader.offsets)
        if len(offsets) and number in reader.formats
    )


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _reader_class(path: Path) -> Any:
    try:
        from pymavlink.DFReader import DFReader_binary  # type: ignore[import-untyped]
    except ImportError:
        raise ImportLogError(
            f"log '{path}': pymavlink is not installed, which reads ArduPilot logs: "
            "pip install 'uav_ident_ros[ardupilot]' or pip install pymavlink"
        ) from None
    return DFReader_binary
