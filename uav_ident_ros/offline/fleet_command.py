# SPDX-License-Identifier: Apache-2.0
"""`fleet`: pooled coefficients and changes of each aircraft, over many replayed flights."""

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from uav_ident_ros.bags.reading import BagError
from uav_ident_ros.bags.writing import BagWriteError
from uav_ident_ros.commandline import OneLineParser, given_path
from uav_ident_ros.files.coefficients_file import CoefficientsFileError, save_coefficients
from uav_ident_ros.offline import NO_RESULT
from uav_ident_ros.offline.fleet import FlownAircraft, fleet_of, read_flights
from uav_ident_ros.offline.job import optional
from uav_ident_ros.offline.tables import columns

DESCRIPTION = """\
Put the flights of each aircraft together: pooled coefficients with their scatter from flight to
flight, flights that stand out, flights without a usable model.
Writes fleet.html, and for each aircraft pooled_AIRCRAFT.yaml: initial coefficients for its next
flight ('initial_coefficients_file').
"""

EPILOG = """\
exit status:
  0  no coefficient has changed
  1  some have, and are named
  2  no result: a table cannot be used

example:
  replay flights/ --params-file vehicle.yaml --output output/fleet
  fleet output/fleet
"""


def main(args: list[str] | None = None) -> int:
    """Run the command; the return value is the exit status, see `fleet --help`."""
    parser = OneLineParser(
        prog="fleet",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    tables_help = "flights.csv or flights.parquet of a replay of many bags, or its folder"
    parser.add_argument("tables", type=given_path, nargs="+", metavar="TABLE", help=tables_help)
    folder_help = "folder of the results (default: of the table)"
    parser.add_argument("--output", type=given_path, metavar="DIR", help=folder_help)
    options = parser.parse_args(args)
    first: Path = options.tables[0]
    folder: Path = options.output or (first if first.is_dir() else first.parent)
    try:
        fleet = fleet_of(row for table in options.tables for row in read_flights(table))
        if not fleet:
            raise BagError(f"'{first}' has no flights")
        files = write_fleet(folder, fleet)
    except (BagError, BagWriteError, CoefficientsFileError) as error:
        print(f"fleet: {error}", file=sys.stderr)
        return NO_RESULT
    print("\n".join(line for aircraft in fleet for line in describe(aircraft)))
    print(f"written: {', '.join(map(str, files))}")
    return int(any(aircraft.findings for aircraft in fleet))


def write_fleet(folder: Path, fleet: Sequence[FlownAircraft]) -> list[Path]:
    """Write the page and the pooled coefficients; return the files."""
    files = [folder / "fleet.html"]
    optional("uav_ident_ros.report.fleet_page").write_fleet_page(files[0], fleet)
    several = {a.name for a in fleet if sum(b.name == a.name for b in fleet) > 1}
    for aircraft in fleet:
        if aircraft.pooled:
            name = re.sub(r"[^\w.-]+", "_", aircraft.name)
            name += f"_{aircraft.structure}" if aircraft.name in several else ""
            files.append(folder / f"pooled_{name}.yaml")
            save_coefficients(aircraft.coefficient_set(), files[-1])
    return files


def describe(aircraft: FlownAircraft) -> Iterator[str]:
    """Yield the lines on an aircraft: counts, table, changes, unusable flights."""
    count = len(aircraft.flights)
    yield f"{aircraft.name}: {count} usable flights, {len(aircraft.unusable)} others"
    if aircraft.pooled:
        yield from columns(aircraft.table)
    for finding in aircraft.findings:
        yield f"change: {finding.text}"
    for flight, why in aircraft.unusable:
        yield f"{flight}: {why}"
    yield ""
