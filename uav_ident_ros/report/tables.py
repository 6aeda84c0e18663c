# SPDX-License-Identifier: Apache-2.0
"""The numbers of the report as tables; those of summary.json are taken from it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from uav_ident_ros.files.meanings import MEANINGS
from uav_ident_ros.files.truth_file import Truth
from uav_ident_ros.identification.linearisation import Mode
from uav_ident_ros.identification.settings import declarations
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.report.analysis import SIGNALS, Spectra, correlations, signals
from uav_ident_ros.report.charts import UNITS
from uav_ident_ros.report.flight import AXES, Flight
from uav_ident_ros.report.predictions import Predictions

if TYPE_CHECKING:  # replay imports the report
    from uav_ident_ros.offline.evidence import Evidence

KNOWN_FROM = 3.0
"""t-ratio from which a coefficient counts as known."""

WORDY = ("meaning", "topic", "type", "dropped", "unit", "default", "SHA-256")
"""Headings of columns of words."""


@dataclass(frozen=True)
class Row:
    """A row of a table: its heading, its cells, and whether it is printed pale."""

    name: str
    cells: Sequence[str]
    weak: bool = False


@dataclass(frozen=True)
class Table:
    """A table of the page; with words in `folded` it is folded up behind them."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Row]
    kind: str = ""
    folded: str = ""


def number(value: float | None, style: str = ".4g", unit: str = "") -> str:
    """Return a number to read, with the exact one in the ``data`` element around it."""
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value:{style}}".replace("-", "−")
    return Markup('<data value="{}">{}{}</data>').format(repr(float(value)), text, unit)


def words(text: str) -> str:
    """Return a cell of words rather than numbers."""
    return Markup('<td class="words">{}</td>').format(text)


def shaded(value: float) -> str:
    """Return a cell that is the darker, the closer a correlation is to 1 or -1."""
    share = abs(value) if math.isfinite(value) else 0.0
    text = number(value, ".2f")
    return Markup('<td class="shaded" style="--share:{:.2f}">{}</td>').format(share, text)


def cell(content: str) -> Markup:
    """Return a cell of a table: as it is, or its text escaped in one."""
    if isinstance(content, Markup) and content.startswith("<td"):
        return content
    return Markup("<td>{}</td>").format(escape(content))


def coefficients_table(summary: Mapping[str, Any], truth: Truth) -> Table:
    """Value, sigma, t-ratio and meaning of every coefficient, and the true value if known."""
    rows = []
    for name, entry in summary["coefficients"].items():
        value, sigma = entry["value"], entry["sigma"]
        ratio = abs(value) / sigma if sigma and value is not None else None
        cells = [
            number(value),
            "fixed" if sigma == 0.0 else number(sigma, ".2g"),
            number(ratio, ".1f"),
            words(MEANINGS.get(name, "")),
        ]
        if truth.values:
            _, true = truth.steps(name, math.inf)
            cells.insert(1, number(true[-1] if true else None))
        rows.append(Row(name, cells, ratio is not None and ratio < KNOWN_FROM))
    head = ["name", "value", "sigma", "t-ratio", "meaning"]
    if truth.values:
        head.insert(2, "true")
    return Table("Coefficients, SI units, body axes FRD", head, rows)


def fit_tables(
    summary: Mapping[str, Any],  # Content of summary.json
    tick: Predictions,  # Predictions over one tick, shown beside the last part of the flight
    end: float,  # End of the flight, s
) -> Iterator[Table]:
    """Yield the fits of the summary, for each selection of windows."""
    captions = {"last_40_percent": "Last 40 % of the flight", "after_30_s": "After 30 s"}
    for windows, fit in summary["prediction_fit"].items():
        rows = [
            Row(name, _percents(values[axis] for axis in AXES))
            for ahead, found in fit["free"].items()
            for name, values in (
                (f"free prediction, {ahead}", found["model"]),
                (f"holding the rates for {ahead}", found["hold"]),
            )
        ]
        measured = fit["model_with_measured_forces"]
        if any(value is not None for value in measured.values()):
            name = "with measured forces, 1 s"
            rows.append(Row(name, _percents(measured[axis] for axis in AXES)))
        if windows == "last_40_percent":
            model, hold = tick.fit(end)
            name = f"one tick ({tick.horizon:g} s) ahead"
            rows.append(Row(name, _percents(model.tolist())))
            rows.append(Row("holding the rates for one tick", _percents(hold.tolist())))
        caption = f"{captions.get(windows, windows)}, {fit['windows']} windows"
        yield Table(caption, ("fit [%]", *AXES), rows, "short")


def _percents(values: Any) -> list[str]:
    return [number(value, ".1f") for value in values]


def gates_table(lost: Mapping[str, float]) -> Table:
    """Share of the flight at which nothing was learned, for each reason."""
    rows = [Row(reason, [number(100.0 * share, ".1f")]) for reason, share in lost.items()]
    rows.append(Row("learned", [number(100.0 * (1.0 - sum(lost.values())), ".1f")]))
    return Table("Where the flight went, share of the ticks", ("reason", "[%]"), rows, "short")


def signals_table(flight: Flight, found: Spectra | None) -> Table:
    """Spread, range and band of every signal."""
    rows = []
    for k, (name, column) in enumerate(zip(SIGNALS, signals(flight).T, strict=True)):
        low, high = math.nan, math.nan
        if found is not None and k < len(INPUTS) + len(AXES):
            m = len(INPUTS)
            density = found.inputs[:, k] if k < m else found.rates[:, k - m]
            low, high = found.band(density)
        cells = [number(float(v), ".2g") for v in (column.min(), column.max(), column.std())]
        cells.append(f"{low:.2g}–{high:.2g}" if math.isfinite(low) else "–")
        rows.append(Row(f"{name} [{UNITS[name]}]" if name in UNITS else name, cells))
    head = ("signal", "least", "most", "std. dev.", "band [Hz]")
    return Table("Range of the signals; inputs from trim", head, rows, "short")


def correlations_table(flight: Flight) -> Table:
    """Correlation of all signals with the inputs."""
    found = correlations(signals(flight))[:, : len(INPUTS)]
    rows = [
        Row(name, [shaded(float(value)) for value in line])
        for name, line in zip(SIGNALS, found, strict=True)
    ]
    return Table("Correlation with the inputs", ("signal", *INPUTS), rows, "short")


def coefficient_correlations(evidence: Evidence) -> Iterator[Table]:
    """Yield how the estimates of a row's coefficients depend on one another."""
    for row, (names, matrix) in evidence.correlations.items():
        rows = [
            Row(name, [shaded(float(v)) if j < i else "" for j, v in enumerate(line[:-1])])
            for i, (name, line) in enumerate(zip(names, matrix, strict=True))
            if i
        ]
        yield Table(f"Correlation of the coefficients of {row}", ("", *names[:-1]), rows, "short")


def modes_table(found: Sequence[Mode]) -> Table:
    """Frequency and damping, or time constant, of every mode with its standard deviation."""
    rows = []
    for mode in found:
        pairs = (
            (mode.frequency, mode.frequency_sigma),
            (mode.damping, mode.damping_sigma),
            (mode.time_constant, mode.time_constant_sigma),
        )
        cells = [
            Markup("{} ± {}").format(number(value, ".3g"), number(sigma, ".2g"))
            if math.isfinite(value)
            else "–"
            for value, sigma in pairs
        ]
        rows.append(Row(mode.name, cells))
    head = ("mode", "frequency [rad/s]", "damping ratio", "time constant [s]")
    return Table("Modes in level flight", head, rows, "short")


def messages_table(summary: Mapping[str, Any]) -> Table:
    """List what became of the messages of every stream."""
    rows = []
    for stream, entry in summary["inputs"].items():
        dropped = ", ".join(f"{count} {why}" for why, count in entry["dropped"].items())
        cells = [words(entry["topic"]), words(entry["type"]), number(entry["received"], "d")]
        rows.append(Row(stream, [*cells, words(dropped or "none")]))
    return Table("Messages", ("stream", "topic", "type", "received", "dropped"), rows)


def settings_tables(summary: Mapping[str, Any]) -> Iterator[Table]:
    """Yield the settings that are not the defaults, and all others folded up."""
    changed, others = [], []
    for setting in declarations():
        value = summary["settings"][setting.name]
        default = list(setting.default) if isinstance(setting.default, tuple) else setting.default
        cells = [words(_shown(value)), words(setting.unit), words(_shown(default))]
        if value == default:
            others.append(Row(setting.name, cells[:2]))
        else:
            changed.append(Row(setting.name, cells))
    head = ("parameter", "value", "unit")
    if changed:
        yield Table("Settings that differ from the defaults", (*head, "default"), changed)
    folded = f"{len(others)} settings at their defaults"
    yield Table("Settings at their defaults", head, others, folded=folded)


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(_shown, value))}]"
    return str(value) if value != "" else "''"


def origin_tables(
    files: Sequence[tuple[str, int, str]], versions: Mapping[str, str]
) -> Iterator[Table]:
    """Yield the files of the bag with their hashes, and the versions of the software."""
    tag = Markup('<td class="words"><span class="hash">{}</span></td>')
    rows = [Row(name, [f"{size}", tag.format(digest)]) for name, size, digest in files]
    yield Table("Bag", ("file", "bytes", "SHA-256"), rows)
    software = [Row(name, [version]) for name, version in versions.items()]
    yield Table("Software", ("package", "version"), software, "short")


def verdict_of(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the verdict in its own words, and where the score of the flight contradicts it."""
    reason, usable = summary["reason"], summary["usable"]
    fit = summary["prediction_fit"]["last_40_percent"]
    lost = [
        axis
        for axis in AXES
        if None not in (fit["model"][axis], fit["hold"][axis])
        and fit["model"][axis] <= fit["hold"][axis]
    ]
    state = f"{summary['state']} ({reason})" if usable and reason else summary["state"]
    doubt = ""
    if usable and lost:
        doubt = (
            f"That is the verdict of the last tick. Over the last 40 % of the flight the model "
            f"predicted {', '.join(lost)} no better than holding the rate: do not use it there."
        )
    text = "usable" if usable else f"not usable: {reason}" if reason else "not usable"
    return {"words": text, "usable": usable, "doubt": doubt, "state": state}
