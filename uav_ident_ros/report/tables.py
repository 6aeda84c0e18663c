# SPDX-License-Identifier: Apache-2.0
"""The numbers of the report as tables; those of summary.json are taken from it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from uav_ident_ros.files.meanings import MEANINGS
from uav_ident_ros.identification.settings import declarations
from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.report.coverage import SIGNALS, correlations, signals
from uav_ident_ros.report.flight import AXES, Flight
from uav_ident_ros.report.markup import Node, element, number, table
from uav_ident_ros.report.predictions import Predictions
from uav_ident_ros.report.spectra import Spectra

KNOWN_FROM = 3.0
"""t-ratio from which a coefficient counts as known."""

UNITS = {
    **dict.fromkeys(INPUTS, ""),
    **dict.fromkeys(AXES, "rad/s"),
    **dict.fromkeys(("ay", "az"), "m/s²"),
}
"""Units of the signals; an input's is that of its channels."""


def words(text: Node) -> Element:
    """Return a cell of words rather than numbers."""
    return element("td", text, class_="words")


def coefficients_table(summary: Mapping[str, Any]) -> Element:
    """Value, sigma, t-ratio and meaning of every coefficient; the unknown ones are dimmed."""
    rows = []
    for name, entry in summary["coefficients"].items():
        value, sigma = entry["value"], entry["sigma"]
        ratio = abs(value) / sigma if sigma and value is not None else None
        rows.append(
            (
                name,
                number(value),
                "fixed" if sigma == 0.0 else number(sigma, ".2g"),
                number(ratio, ".1f"),
                words(MEANINGS[name]),
            )
        )
    result = table("Coefficients, SI units, body axes FRD", _COEFFICIENT_HEAD, rows)
    for line, row in zip(result.iter("tr"), [None, *rows], strict=True):
        if row is not None and _weak(row[3]):
            line.set("class", "weak")
    return result


_COEFFICIENT_HEAD: Sequence[Node] = (
    "name",
    "value",
    "sigma",
    "t-ratio",
    "meaning",
)


def _weak(ratio: Node) -> bool:
    return isinstance(ratio, Element) and float(ratio.get("value", "0")) < KNOWN_FROM


def fit_table(
    caption: str, fit: Mapping[str, Any], tick: Predictions | None, end: float
) -> Element:
    """Fit of every axis beside that of holding the rates, for one selection of windows.

    Parameters
    ----------
    caption : str
        Which windows.
    fit : mapping
        Their entry in summary.json.
    tick : Predictions, optional
        Predictions over one tick, to be shown too.
    end : float
        End of the flight, s.
    """
    names = {
        "model": "identified model, 1 s ahead",
        "model_with_ay_az_held": "the same with ay, az held",
        "hold": "holding the rates for 1 s",
    }
    rows: list[tuple[Node, ...]] = [
        (name, *(number(fit[key][axis], ".1f") for axis in AXES))
        for key, name in names.items()
        if key != "model_with_ay_az_held" or any(fit[key][axis] is not None for axis in AXES)
    ]
    if tick is not None:
        model, hold = tick.fit(end)
        ahead = f"{tick.horizon:g} s"
        rows.append((f"identified model, one tick ({ahead}) ahead", *_percents(model)))
        rows.append(("holding the rates for one tick", *_percents(hold)))
    return table(caption, ("fit [%]", *AXES), rows, class_="short")


def _percents(values: FloatArray) -> list[Node]:
    return [number(float(value), ".1f") for value in values]


def signals_table(flight: Flight, found: Spectra | None) -> Element:
    """Spread, range and band of every signal."""
    density = np.empty((0, 0))
    if found is not None:
        density = np.concatenate([found.inputs, found.rates], axis=1)
    rows: list[tuple[Node, ...]] = []
    for k, (name, column) in enumerate(zip(SIGNALS, signals(flight).T, strict=True)):
        low, high = math.nan, math.nan
        if found is not None and k < density.shape[1]:
            low, high = found.band(density[:, k])
        unit = UNITS[name]
        rows.append(
            (
                f"{name}\u00a0[{unit}]" if unit else name,
                number(float(column.min()), ".2g"),
                number(float(column.max()), ".2g"),
                number(float(column.std()), ".2g"),
                f"{low:.2g}–{high:.2g}" if math.isfinite(low) else "–",
            )
        )
    head = ("signal", "least", "most", "std. dev.", "band [Hz]")
    return table("Range of the signals; inputs from trim", head, rows, class_="short")


def correlations_table(flight: Flight) -> Element:
    """Correlation of all signals with the inputs."""
    rows: list[tuple[Node, ...]] = [
        (name, *(_correlation(float(value)) for value in line))
        for name, line in zip(SIGNALS, correlations(flight).T, strict=True)
    ]
    caption = "Correlation with the inputs"
    return table(caption, ("signal", *INPUTS), rows, class_="correlations short")


def _correlation(value: float) -> Element:
    if not math.isfinite(value):
        return element("td", "–", style="--share:0")
    return element("td", number(value, ".2f"), style=f"--share:{abs(value):.2f}")


def messages_table(summary: Mapping[str, Any]) -> Element:
    """List what became of the messages of every stream."""
    rows = [
        (
            stream,
            words(entry["topic"]),
            words(entry["type"]),
            number(entry["received"], "d"),
            words(", ".join(f"{count} {why}" for why, count in entry["dropped"].items()) or "none"),
        )
        for stream, entry in summary["inputs"].items()
    ]
    return table("Messages", ("stream", "topic", "type", "received", "dropped"), rows)


def settings_tables(summary: Mapping[str, Any]) -> Iterator[Element]:
    """Yield the settings that are not the defaults, and all others folded up."""
    changed, others = [], []
    for setting in declarations():
        value = summary["settings"][setting.name]
        default = list(setting.default) if isinstance(setting.default, tuple) else setting.default
        row = (setting.name, words(_shown(value)), words(setting.unit), words(_shown(default)))
        if value == default:
            others.append(row[:3])
        else:
            changed.append(row)
    if changed:
        yield table("Settings that differ from the defaults", (*_SETTING_HEAD, "default"), changed)
    yield element(
        "details",
        element("summary", f"{len(others)} settings at their defaults"),
        table("Settings at their defaults", _SETTING_HEAD, others),
    )


_SETTING_HEAD = ("parameter", "value", "unit")


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(_shown, value))}]"
    return str(value) if value != "" else "''"


def provenance_tables(
    files: Sequence[tuple[str, int, str]], versions: Mapping[str, str]
) -> Iterator[Element]:
    """Yield the files of the bag with their hashes, and the versions of the software."""
    yield table(
        "Bag",
        ("file", "bytes", "SHA-256"),
        [
            (name, f"{size}", element("td", element("span", digest, class_="hash"), class_="words"))
            for name, size, digest in files
        ],
    )
    yield table("Software", ("package", "version"), versions.items(), class_="short")
