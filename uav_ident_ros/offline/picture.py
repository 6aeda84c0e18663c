# SPDX-License-Identifier: Apache-2.0
"""The picture of a replay."""

from __future__ import annotations

from pathlib import Path

from uav_ident_ros.files.truth_file import read_truth
from uav_ident_ros.offline.drawing import Overview, save_overview
from uav_ident_ros.offline.evidence import FIT_WINDOWS
from uav_ident_ros.offline.replayed import Replayed
from uav_ident_ros.report.flight import collect
from uav_ident_ros.report.predictions import predict

HORIZON = 1.0
"""How far ahead the predictions of the picture are, s: that of the score of record."""


def write_picture(path: Path, bag: Path, replayed: Replayed) -> None:
    """Draw the rates beside their predictions and the coefficients beside the truth.

    Parameters
    ----------
    path : Path
        The PNG.
    bag : Path
        The bag that was replayed; the truth lies beside it if the flight was simulated.
    replayed : Replayed
        The replay.

    Raises
    ------
    PictureError
        If it cannot be drawn or written.
    """
    flight = collect(replayed.name, replayed.run)
    ahead = predict(flight, HORIZON)
    fit = replayed.fits[FIT_WINDOWS]
    notes = tuple(
        f"1-second prediction fit {model:.1f} %, holding the rates {hold:.1f} %"
        for model, hold in zip(fit.model, fit.hold, strict=True)
    )
    overview = Overview(
        title=f"{flight.name}: {flight.settings.estimator}, {flight.structure.name}",
        horizon=HORIZON,
        t=ahead.t,
        measured=ahead.measured,
        predicted=ahead.predicted,
        tick_t=flight.tick_t,
        coefficients=flight.coefficients,
        sigma=flight.sigma,
        structure=flight.structure,
        truth=read_truth(bag, flight.structure).values,
        notes=notes,
    )
    save_overview(path, overview)
