# SPDX-License-Identifier: Apache-2.0
"""One row per flight: verdict and main derivatives of every replay below a folder."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

SHOWN = ("pdot/p", "pdot/da", "qdot/q", "qdot/de", "rdot/r", "rdot/dr")
"""Damping and control derivative of each axis."""


def row(summary: Path) -> str:
    """Return the row of one flight."""
    content = json.loads(summary.read_text(encoding="utf-8"))
    coefficients = content["coefficients"]
    cells = [
        f"{coefficients[name]['value']:.2f} ± {coefficients[name]['sigma']:.2f}" for name in SHOWN
    ]
    verdict = "usable" if content["usable"] else "not usable"
    return f"{content['bag']:<16}{verdict:<12}" + "".join(f"{cell:>18}" for cell in cells)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="what `replay BAGS --output FOLDER` wrote")
    found = sorted(parser.parse_args().folder.rglob("summary.json"))
    print(f"{'flight':<16}{'verdict':<12}" + "".join(f"{name:>18}" for name in SHOWN))
    print("\n".join(map(row, found)))


if __name__ == "__main__":
    main()
