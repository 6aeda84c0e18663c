# SPDX-License-Identifier: Apache-2.0
"""One bag replayed with one configuration: the job and its outcome."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from uav_ident_ros.bags.reading import Bag, BagError
from uav_ident_ros.bags.writing import BagWriteError, write_file
from uav_ident_ros.commandline import NOT_USABLE, USABLE, missing
from uav_ident_ros.files.coefficients_file import (
    CoefficientsFileError,
    initial_coefficients,
    save_coefficients,
)
from uav_ident_ros.files.parameter_file import PARAMETER_FILE, ParameterFile, ParameterFileError
from uav_ident_ros.identification.settings import SettingsError
from uav_ident_ros.identification.structure import RATES
from uav_ident_ros.messages.types import MessageTypeError
from uav_ident_ros.offline import NO_RESULT, NODE_NAME
from uav_ident_ros.offline.evidence import FIT_WINDOWS, gather
from uav_ident_ros.offline.find import RESULT_BAG, RESULT_FILE
from uav_ident_ros.offline.inputs import choose_inputs
from uav_ident_ros.offline.run import OfflineRun
from uav_ident_ros.offline.summary import Replayed, notes_on
from uav_ident_ros.offline.tables import write_table
from uav_ident_ros.offline.ticks import check_place, write_estimates


def optional(module: str) -> Any:
    """Return a module; raises `BagError` if it needs a package that is missing or broken."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise BagError(missing(error)) from None
    except ImportError as error:  # as of a matplotlib that was built for another NumPy
        raise BagError(f"'{module}' cannot be imported: {error}") from None


@contextmanager
def reserved(folder: Path) -> Iterator[None]:
    """Make a folder of results, and reserve it for the replays of the block.

    The reservation ends with the process, however that ends. A folder that is left empty is
    removed. Raises `BagWriteError` if it cannot be written, or if another replay writes into it.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        with suppress(FileExistsError):
            folder.mkdir(parents=True)
        held = os.open(folder, os.O_DIRECTORY)
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise BagWriteError(f"cannot write into '{folder}': {error.strerror}") from None
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BagWriteError(
                f"another replay writes into '{folder}': wait for its end, or choose another "
                "--output"
            ) from None
        except OSError:  # a network drive without locks
            pass
        yield
    finally:
        for path in missing:
            with suppress(OSError):
                path.rmdir()
        os.close(held)


# --- the job --------------------------------------------------------------------------------------


REPLAY_REFUSALS = (
    BagError,
    BagWriteError,
    CoefficientsFileError,
    MessageTypeError,
    ParameterFileError,
    SettingsError,
)
"""Exceptions of bad input."""

VERDICTS = {USABLE: "usable", NOT_USABLE: "not usable", NO_RESULT: "no result"}
"""Text for each status of a replay."""


@dataclass(frozen=True)
class Job:
    """One bag to be replayed with one configuration."""

    bag: Path
    name: str  # Name of the results
    folder: Path  # Folder of the results
    params_files: tuple[Path, ...] = ()  # Parameter files; later ones override earlier ones
    node: str = NODE_NAME  # Node whose sections of the files count
    # Requested topics, by stream as in `STREAMS`; the others are found
    topics: Mapping[str, str] = field(default_factory=dict)
    # plot, report: Whether to draw the picture, and to write the report
    plot: bool = False
    report: bool = False
    aircraft: str = ""  # Name of the aircraft
    again: bool = False  # Whether to replay even if the result exists already

    @cached_property
    def files(self) -> list[ParameterFile]:
        """The parameter files, read once; raises `ParameterFileError`."""
        return [ParameterFile.read(path) for path in self.params_files]

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters by name; raises `ParameterFileError`."""
        found = (file.parameters_for(self.node) for file in self.files)
        return {name: value for values in found for name, value in values.items()}


@dataclass(frozen=True)
class Outcome:
    """Outcome of a job."""

    job: Job
    status: int  # `USABLE`, `NOT_USABLE` or `NO_RESULT`
    warnings: tuple[str, ...] = ()  # Problems of the input; without a result the last is the reason
    # Content of summary.json; empty if there is none
    summary: Mapping[str, Any] = field(default_factory=dict)
    identity: str = ""  # Hashes of bag and settings (`parallel.identity_of`); empty if unknown
    kept: bool = False  # Whether an earlier result was kept

    @property
    def reason(self) -> str:
        """Reason of a model that is not usable, or of no result; empty if usable."""
        if self.status == NO_RESULT:
            return self.warnings[-1].splitlines()[0] if self.warnings else ""
        return str(self.summary["doubt"]) if self.status == NOT_USABLE else ""

    @property
    def verdict(self) -> str:
        """Text of the status, with the reason if there is one."""
        return f"{VERDICTS[self.status]}: {self.reason}" if self.reason else VERDICTS[self.status]

    def fit(self, kind: str = "model") -> Mapping[str, float | None]:
        """1-second fit of p, q, r over the last 40 %, percent, of the ``model`` or of ``hold``."""
        if not self.summary:
            return dict.fromkeys(RATES)
        fit: Mapping[str, float | None] = self.summary["prediction_fit"][FIT_WINDOWS][kind]
        return fit


def replay(
    job: Job,
    shown: bool = False,  # Whether to show a progress bar
) -> Outcome:
    """Do a job: run the identifier on the bag and write the results.

    `REPLAY_REFUSALS` are not raised: bad input gives an outcome without a result.
    """
    warnings: list[str] = []
    try:
        # before the run, which may take minutes
        check_place(job.folder / RESULT_BAG)
        draw = optional("uav_ident_ros.report.picture").write_picture if job.plot else None
        report = optional("uav_ident_ros.report.page").write_report if job.report else None
        run, notes = _run(job, shown, warnings)
        fits = run.score()
        replayed = Replayed(job.name, job.bag, run, fits, gather(run, fits), notes)
        write_results(job.folder, replayed)
        if draw:
            draw(job.folder / "replay.png", replayed)
        if report:
            report(job.folder / "report.html", replayed)
    except REPLAY_REFUSALS as error:
        return Outcome(job, NO_RESULT, (*warnings, str(error)))
    status = NOT_USABLE if replayed.doubt else USABLE
    return Outcome(job, status, tuple(warnings), replayed.summary)


def write_results(folder: Path, replayed: Replayed) -> None:
    """Write summary, table, bag of estimates and coefficients; raises some of `REPLAY_REFUSALS`."""
    run, summary = replayed.run, json.dumps(replayed.summary, indent=2, allow_nan=False)
    write_file(folder / RESULT_FILE, f"{summary}\n")
    write_file(folder / "table.txt", f"{write_table(replayed.summary)}\n")
    write_estimates(folder / RESULT_BAG, run.estimates, run.frame_id or "")
    save_coefficients(run.result(), folder / "coefficients.yaml")


def _run(job: Job, shown: bool, warnings: list[str]) -> tuple[OfflineRun, tuple[str, ...]]:
    """Run the identifier on the bag; return the run, and notes on the bag."""
    values = job.parameters
    warnings += (doubt for file in job.files for doubt in file.doubts(job.node))
    with Bag(job.bag) as bag:
        try:
            inputs = choose_inputs(bag, values, job.topics)
            run = OfflineRun(inputs, initial_coefficients(inputs.settings))
            run.run(bag, shown)
            warnings += [f"fault: {run.fault}"] if run.fault else []
            noted = run.identifier.plausibility.noted.values()
            warnings += [f"implausible: {found.text}" for found in noted]
            if not run.estimates:
                raise BagError(f"bag '{job.bag}': no tick came due: {_no_tick_reason(run)}")
        except REPLAY_REFUSALS:
            warnings += bag.damage  # a possible cause
            raise
        unread = None if job.params_files else parameters_beside(job.bag)
        hint = [f"{unread} was not read: give it as --params-file"] if unread else []
        return run, (*notes_on(bag, run), *hint)


def parameters_beside(bag: Path) -> Path | None:
    """Return the parameter file that `simulate` or `import_log` wrote beside a bag, if any."""
    file = (bag if bag.is_dir() else bag.parent) / PARAMETER_FILE
    return file if file.is_file() else None


def _no_tick_reason(run: OfflineRun) -> str:
    rates, topic = run.refusals("rates"), run.inputs.streams["rates"]
    if not rates.dropped:
        return f"'{topic}' has {rates.received} messages, too few for one tick"
    return f"of {rates.received} messages on '{topic}' were dropped: {rates.text}"
