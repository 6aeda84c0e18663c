# SPDX-License-Identifier: Apache-2.0
"""The declaration: which curves of which topics stand where. Both programs are written from it."""

from __future__ import annotations

from dataclasses import dataclass

from uav_ident_ros.identification.structure import INPUTS, ROWS, Structure
from uav_ident_ros.messages.types import FIT_NAMES, USABLE_NAME

AXES = ("p", "q", "r")
ROTATIONS = {"x": "roll", "y": "pitch", "z": "yaw"}
"""Rotations by the component of a vector in the Imu's frame."""

STATES = ("p", "q", "r")
DIAGNOSTICS_TOPIC = "/diagnostics"

BLUE, RED, GREEN, ORANGE = "#1f77b4", "#d62728", "#2ca02c", "#ff7f0e"
COLOURS = (
    BLUE, RED, GREEN, ORANGE, "#9467bd", "#8c564b", "#e377c2", "#17becf", "#bcbd22",
)  # fmt: skip
"""Colours that can be told apart, in this order."""


@dataclass(frozen=True)
class Field:
    """A number in a message.

    Parameters
    ----------
    topic : str
        Full name of the topic.
    path : str
        Dotted path of the field.
    """

    topic: str
    path: str


@dataclass(frozen=True)
class Entry:
    """An entry of ~/coefficients_named.

    Parameters
    ----------
    topic : str
        Full name of the topic.
    name : str
        Name of the entry.
    part : str
        ``position`` for its value, ``effort`` for its standard deviation.
    """

    topic: str
    name: str
    part: str = "position"


@dataclass(frozen=True)
class Diagnostic:
    """A value of the node's status on /diagnostics.

    Parameters
    ----------
    node : str
        Full name of the node.
    key : str
        Label of the value.
    """

    node: str
    key: str


Source = Field | Entry | Diagnostic


@dataclass(frozen=True)
class Curve:
    """A curve in a plot."""

    label: str
    source: Source
    colour: str


@dataclass(frozen=True)
class Plot:
    """A plot over time.

    Parameters
    ----------
    title : str
        What it shows, with the unit.
    curves : tuple of Curve
        Its curves.
    limits : tuple of two floats, optional
        Least and largest value shown; free if left out.
    """

    title: str
    curves: tuple[Curve, ...]
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Page:
    """A tab of plots, row by row."""

    title: str
    rows: tuple[tuple[Plot, ...], ...]


@dataclass(frozen=True)
class Names:
    """What the topics are called.

    Parameters
    ----------
    node : str
        Full name of the identifier.
    rates_topic : str
        Full name of the topic of the measured rates, of type sensor_msgs/msg/Imu.
    structure : Structure
        Structure of the coefficients.
    """

    node: str
    rates_topic: str
    structure: Structure

    @property
    def coefficients(self) -> str:
        """Topic of the coefficients by name."""
        return f"{self.node}/coefficients_named"

    @property
    def topics(self) -> tuple[str, ...]:
        """Every topic that is shown."""
        outputs = ("coefficients_named", "predicted_rates", "prediction_error")
        return (
            *(f"{self.node}/{name}" for name in outputs),
            self.rates_topic,
            DIAGNOSTICS_TOPIC,
        )


def pages(names: Names) -> tuple[Page, ...]:
    """Return everything that is shown."""
    return (
        _rates(names),
        _coefficients("Coefficients", "position", names),
        _coefficients("Standard deviations", "effort", names),
        _verdict(names),
    )


def _coloured(sources: list[tuple[str, Source]]) -> tuple[Curve, ...]:
    return tuple(
        Curve(label, source, COLOURS[i % len(COLOURS)]) for i, (label, source) in enumerate(sources)
    )


def _rates(names: Names) -> Page:
    """Measured against predicted rates, and their difference: a row for each axis of the Imu."""
    rows = []
    for component, rotation in ROTATIONS.items():
        measured = Field(names.rates_topic, f"angular_velocity.{component}")
        predicted = Field(f"{names.node}/predicted_rates", f"vector.{component}")
        error = Field(f"{names.node}/prediction_error", f"vector.{component}")
        rows.append(
            (
                Plot(
                    f"{rotation}, Imu's {component}: measured and predicted [rad/s]",
                    (
                        Curve(f"{component} measured", measured, BLUE),
                        Curve(f"{component} predicted", predicted, RED),
                    ),
                ),
                Plot(
                    f"{rotation}, Imu's {component}: measured minus predicted [rad/s]",
                    (Curve(f"{component} error", error, ORANGE),),
                ),
            )
        )
    return Page("Rates", tuple(rows))


def _coefficients(title: str, part: str, names: Names) -> Page:
    """Coefficients of a row of A in a row: damping, controls, and what is left."""
    structure = names.structure
    rows = []
    for row in ROWS:
        regressors = [n.partition("/")[2] for n in structure.names if n.startswith(f"{row}/")]
        groups = {
            "rates [1/s]": [r for r in regressors if r in STATES],
            "controls [1/s² per unit]": [r for r in regressors if r in INPUTS],
            "others [SI]": [r for r in regressors if r not in (*STATES, *INPUTS)],
        }
        rows.append(
            tuple(
                Plot(
                    f"{row}: {group}",
                    _coloured(
                        [
                            (f"{row}/{r}", Entry(names.coefficients, f"{row}/{r}", part))
                            for r in members
                        ]
                    ),
                )
                for group, members in groups.items()
            )
        )
    return Page(title, tuple(rows))


def _verdict(names: Names) -> Page:
    """How good the model is, how well excited the flight, and what arrives."""

    def status(*keys: str) -> tuple[Curve, ...]:
        return _coloured([(key, Diagnostic(names.node, key)) for key in keys])

    fit = _coloured([(name, Entry(names.coefficients, name)) for name in FIT_NAMES])
    usable = (Curve("usable", Entry(names.coefficients, USABLE_NAME), GREEN),)
    return Page(
        "Verdict",
        (
            (
                Plot("1-second prediction fit [%]", fit, (-50.0, 100.0)),
                Plot("fit of holding the rate [%]", status(*(f"hold {a} [%]" for a in AXES)),
                     (-50.0, 100.0)),
            ),
            (
                Plot("usable", usable, (-0.1, 1.1)),
                Plot("excitation of the rows", status(*(f"excitation {r} [0..1]" for r in ROWS)),
                     (0.0, 1.0)),
            ),
            (
                Plot("messages [1/s]", status("rates: rate [Hz]", "actuators: rate [Hz]")),
                Plot("delay of the inputs [s]", status("delay [s]")),
            ),
        ),
    )  # fmt: skip
