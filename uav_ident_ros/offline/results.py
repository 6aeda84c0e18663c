# SPDX-License-Identifier: Apache-2.0
"""What a replay leaves in its folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from uav_ident_ros.bags.writing import BagWriteError
from uav_ident_ros.files.coefficients_file import save_coefficients
from uav_ident_ros.offline.estimates_bag import write_estimates
from uav_ident_ros.offline.replayed import Replayed
from uav_ident_ros.offline.summary import summarise
from uav_ident_ros.offline.table import write_table


def write_results(folder: Path, replayed: Replayed, node: str) -> tuple[dict[str, Any], str]:
    """Write the bag of estimates, the summary, the table and the coefficients.

    Parameters
    ----------
    folder : Path
        Where to; made if it is not there.
    replayed : Replayed
        The replay.
    node : str
        Node whose topics the bag of estimates has.

    Returns
    -------
    dict, str
        Content of summary.json and of table.txt.

    Raises
    ------
    BagWriteError, CoefficientsFileError
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
    return summary, table
