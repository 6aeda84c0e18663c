# SPDX-License-Identifier: Apache-2.0
"""The picture of a replay: rates with their predictions, coefficients with true values."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from uav_ident_ros.bags.writing import whole
from uav_ident_ros.files.truth_file import read_truth
from uav_ident_ros.identification.structure import RATES, ROWS
from uav_ident_ros.offline.evidence import FIT_WINDOWS
from uav_ident_ros.offline.summary import Replayed
from uav_ident_ros.report.flight import Predictions, ReplayedFlight
from uav_ident_ros.report.style import COLORS, HUES

SIZE = (13.0, 8.0)
"""Size of the picture, inches."""

DPI = 110

DETAIL = 25.0
"""Time shown in the panels of rates, s: in a longer one the prediction hides the measurement."""

PANEL_HEADROOM = 1.3
"""Range of a panel over that of the values it is scaled by: a divergent curve leaves it."""

BAND = 2.0
"""Half width of the band around a coefficient, standard deviations."""


def write_picture(
    path: Path,  # The PNG
    replayed: Replayed,  # The replay; a simulated bag has a file of true values
) -> None:
    """Draw a replay as a PNG; raises `BagWriteError` if the file cannot be written."""
    flight, fit = replayed.flight, replayed.fits[FIT_WINDOWS]
    truth = read_truth(replayed.bag, flight.structure)
    figure = Figure(figsize=SIZE, layout="constrained")
    panels = figure.subplots(3, 2, sharex="col", width_ratios=(1.1, 1.0))
    for axis, (left, right) in enumerate(panels):
        left.set_title(
            f"{RATES[axis]}: 1-second prediction fit {fit.model[axis]:.1f} %, "
            f"holding the rates {fit.hold[axis]:.1f} %",
            fontsize="medium",
            loc="left",
        )
        _draw_rate(left, axis, flight.ahead)
        _draw_coefficients(right, axis, flight, truth)
    for panel in panels[2]:
        panel.set_xlabel("time [s]")
    dashed = ", dashed: truth" if truth else ""
    panels[0][1].set_title(
        f"coefficients [SI], band: ±{BAND:g} standard deviations{dashed}",
        fontsize="medium",
        loc="left",
    )
    panels[0][0].legend(loc="upper left", ncols=2, fontsize="small")
    figure.suptitle(f"{replayed.name}: {flight.settings.estimator}, {flight.structure.name}")
    with whole(path) as part:
        # Without the software's name and version the same data give the same bytes.
        figure.savefig(part, dpi=DPI, metadata={"Software": None})


def _draw_rate(panel: Any, axis: int, ahead: Predictions) -> None:
    """Draw the end of the flight: the measurement as a wide line, the prediction as a thin one."""
    shown = ahead.t >= ahead.t.max(initial=0.0) - DETAIL
    t, measured = ahead.t[shown], ahead.measured[shown, axis]
    panel.plot(t, measured, color=COLORS["measured"], alpha=0.55, linewidth=3.5, label="measured")
    panel.plot(
        t, ahead.predicted[shown, axis],
        color=COLORS["ahead"], linewidth=1.0, label=f"predicted {ahead.horizon:g} s before",
    )  # fmt: skip
    # a least range, for panels without samples or motion
    limit = PANEL_HEADROOM * max(float(np.abs(measured).max(initial=0.0)), 1e-3)
    panel.set_ylim(-limit, limit)
    panel.set_ylabel(f"{RATES[axis]} [rad/s]")
    panel.grid(alpha=0.3)


def _draw_coefficients(
    panel: Any, row: int, flight: ReplayedFlight, truth: Mapping[str, float]
) -> None:
    """Draw the damping and control derivatives of a row with their bands and true values."""
    regressors = flight.structure.regressors
    columns = [j for i, j in flight.structure.free if i == row and regressors[j] in HUES]
    # the second half sets the range: estimates of the first half may not have settled
    histories = {j: flight.estimates.history((row, j)) for j in columns}
    settled = np.array([values[len(values) // 2 :] for values, _ in histories.values()])
    known = [truth[name] for j in columns if (name := f"{ROWS[row]}/{regressors[j]}") in truth]
    reach = np.array([0.0, *settled.ravel(), *known])
    low, high = float(reach.min()), float(reach.max())
    margin = (PANEL_HEADROOM - 1.0) * max(high - low, 1e-3)
    panel.set_ylim(low - margin, high + margin)
    panel.grid(alpha=0.3)
    for j in sorted(columns, key=lambda j: -histories[j][0][-1]):
        name, colour = f"{ROWS[row]}/{regressors[j]}", HUES[regressors[j]]
        values, sigma = histories[j]
        panel.fill_between(
            flight.tick_t, values - BAND * sigma, values + BAND * sigma,
            where=BAND * sigma < high - low + margin, color=colour, alpha=0.25, linewidth=0.0,
        )  # fmt: skip
        text = f"{name}  {with_sigma(values[-1], sigma[-1])}"
        panel.plot(flight.tick_t, values, color=colour, linewidth=1.3, label=text)
        if name in truth:
            panel.axhline(truth[name], color=colour, linestyle="--", linewidth=1.1)
    # in the vertical order of the curves
    panel.legend(
        loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small", frameon=False,
        labelcolor="linecolor", handlelength=1.0,
    )  # fmt: skip


def with_sigma(value: float, sigma: float) -> str:
    """Return a value with its standard deviation, to two significant figures of the latter."""
    if not (0.0 < sigma < np.inf):
        return f"{value:.3g}"
    places = max(0, 1 - int(np.floor(np.log10(sigma))))
    return f"{value:.{places}f} ± {sigma:.{places}f}"
