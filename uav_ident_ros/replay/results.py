# SPDX-License-Identifier: Apache-2.0
"""What a replay leaves in its folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.bags.writing import BagWriteError
from uav_ident_ros.files.coefficients_file import save_coefficients
from uav_ident_ros.offline.estimates_bag import write_estimates
from uav_ident_ros.pictures import save_overview
from uav_ident_ros.replay.evidence import FIT_WINDOWS
from uav_ident_ros.replay.replayed import Replayed
from uav_ident_ros.replay.summary import summarise
from uav_ident_ros.replay.table import write_table


def write_results(
    folder: Path, replayed: Replayed, node: str, *, plot: bool = False
) -> tuple[dict[str, Any], str]:
    """Write the bag of estimates, the summary, the table and the coefficients.

    Parameters
    ----------
    folder : Path
        Where to; made if it is not there.
    replayed : Replayed
        The replay.
    node : str
        Node whose topics the bag of estimates has.
    plot : bool
        Whether to draw the picture too.

    Returns
    -------
    dict, str
        Content of summary.json and of table.txt.

    Raises
    ------
    BagWriteError, CoefficientsFileError, PictureError
        If something cannot be written.
    """
    run = replayed.run
    summary, table = summarise(replayed), write_table(replayed)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        (folder / "summary.json").write_text(text, encoding="utf-8")
        (folder / "table.txt").write_text(f"{table}\n", encoding="utf-8")
    except OSError as error:
        raise BagWriteError(f"cannot write to '{folder}': {error.strerror}") from None
    write_estimates(folder / "estimates", run.estimates, run.structure, node, run.frame_id or "")
    save_coefficients(run.result(), folder / "coefficients.yaml")
    if plot:
        _draw(folder / "replay.png", replayed)
    return summary, table


def _draw(path: Path, replayed: Replayed) -> None:
    """Draw the flight."""
    run = replayed.run
    first_ns = run.estimates[0].t_ns
    fit = replayed.fits[FIT_WINDOWS]
    notes = [
        f"1-second prediction fit {model:.1f} %, holding the rates {hold:.1f} %"
        for model, hold in zip(fit.model, fit.hold, strict=True)
    ]
    predicted = np.array([estimate.predicted_rates for estimate in run.estimates])
    error = np.array([estimate.prediction_error for estimate in run.estimates])
    save_overview(
        path,
        t=np.array([(estimate.t_ns - first_ns) * 1e-9 for estimate in run.estimates]),
        measured=predicted + error,
        predicted=predicted,
        coefficients=np.array([estimate.coefficients for estimate in run.estimates]),
        structure=run.structure,
        title=f"{replayed.name}: {run.inputs.settings.estimator}, {run.structure.name}",
        notes=(notes[0], notes[1], notes[2]),
    )
