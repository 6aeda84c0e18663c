# SPDX-License-Identifier: Apache-2.0
"""Identified derivatives beside the true ones: ``python benchmarks/derivatives.py [AIRCRAFT ...]``.

Each aircraft flies two minutes of multisines in calm air and is identified once, online. The true
derivatives are central differences of its accelerations, trimmed at the flight's mean airspeed:
excitation at trim throttle slows the c172p by 3 %, which is 7 % of pdot/da. Those by the throttle
are omitted, because an engine follows within a second. Those of `augmented` hold at fixed ay and
az, the true ones at fixed alpha and beta: only the aileron's is comparable.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import bench
import cases
import numpy as np

from uav_ident_ros.files.coefficients_file import load_coefficients
from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.linearisation import level_modes
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.simulation.aircraft import Linearisation, linearise_cruise
from uav_ident_ros.simulation.airframe import airframe, airframe_names
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.jsbsim_flight import AircraftFlight
from uav_ident_ros.simulation.noise import Sensors, measure

DURATION = 120.0
SENSORS = Sensors(rate=200.0, gyro_noise=0.005, accelerometer_noise=0.05)


def identified(
    aircraft: str, seed: int, values: Mapping[str, object]
) -> tuple[CoefficientSet, float]:
    """Fly and identify an aircraft; return the final coefficients and the mean airspeed, m/s."""
    segment = Segment("multisine", start=2.0, amplitudes=airframe(aircraft).excitation, seed=seed)
    flight = AircraftFlight((segment,), DURATION, aircraft=aircraft, seed=seed).fly()
    assert flight.airspeed is not None
    case = cases.measured(measure(flight, SENSORS, seed))
    track = cases.identify(case, values)
    found = CoefficientSet(track.structure.name, track.coefficients[-1], track.sigma[-1])
    return found, float(flight.airspeed.mean())


def lines(found: CoefficientSet, truth: Linearisation) -> Iterator[str]:
    """Yield the table of the common derivatives, and their largest errors."""
    structure, true = STRUCTURES[found.structure], truth.derivatives
    yield f"{'':12} {'true':>10} {'identified':>10} {'sigma':>9} {'error, %':>9} {'in sigma':>9}"
    for name in structure.names:
        if name not in true or name.endswith("/dth"):
            continue
        value, sigma = (
            float(matrix[structure.index(name)]) for matrix in (found.values, found.sigma)
        )
        error = value - true[name]
        percent = 100.0 * error / abs(true[name]) if abs(true[name]) > 1e-3 else np.nan
        share = error / sigma if sigma > 0.0 else np.nan
        yield f"{name:12} {true[name]:10.3f} {value:10.3f} {sigma:9.3f} {percent:9.1f} {share:9.1f}"


def mode_lines(found: CoefficientSet, truth: Linearisation) -> Iterator[str]:
    """Yield eigenvalues, frequency and damping of the true and the identified modes."""
    structure, true = STRUCTURES[found.structure], truth.derivatives
    values = np.zeros(structure.mask.shape)
    for name in set(structure.names) & set(true):
        values[structure.index(name)] = true[name]
    own, exact = (
        {mode.name: mode.eigenvalue for mode in level_modes(structure, a, 0.0 * a, truth.airspeed)}
        for a in (found.values, values)
    )
    for name, value in exact.items():
        yield f"{name:12} {_mode(value)}   identified {_mode(own.get(name))}"


def _mode(value: complex | None) -> str:
    if value is None:
        return "none of that name"
    if not value.imag:
        return f"{value.real:.2f} 1/s"
    size = abs(value)
    return f"{value:.2f} 1/s ({size:.2f} rad/s, damping ratio {-value.real / size:.2f})"


def main() -> None:
    """Print the tables."""
    parser = bench.parser(__doc__, seed=1)
    parser.add_argument("aircraft", nargs="*", default=list(airframe_names()), help="default: all")
    parser.add_argument("--structure", choices=tuple(STRUCTURES), help="default: the setting's")
    parser.add_argument("--coefficients", type=Path, help="compare this file: fly nothing")
    options = parser.parse_args()
    values = {"structure": options.structure} if options.structure else {}
    for aircraft in options.aircraft:
        speed = None
        if options.coefficients:
            found = load_coefficients(options.coefficients)
        else:
            found, speed = identified(aircraft, options.seed, values)
        truth = linearise_cruise(aircraft, speed)
        print(f"\n{aircraft}, {truth.airspeed:.1f} m/s, structure {found.structure}")
        for line in (*lines(found, truth), *mode_lines(found, truth)):
            print(line)


if __name__ == "__main__":
    main()
