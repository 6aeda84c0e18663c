# SPDX-License-Identifier: Apache-2.0
"""Excitation in the closed loop, many flights: ``python benchmarks/excitation.py [--seeds N]``.

JSBSim's c172p banks and pitches as in normal flight, under the example controller on fixed nominal
coefficients; the identifier has no initial ones. A run of excitation is requested after ten
seconds, at a tenth of each surface's range. All parts run in one process, without ROS. The table
has for each severity of turbulence: the peaks of rates and attitude until two seconds after the
run, relative to the limits; how and when the runs end; rms of rates minus reference; the errors of
the dominant derivatives.

``--quadrotor``: the quadrotor in hover, which loses 30 % of a motor's thrust after the excitation.
``--untold``, too: neither delay nor lag of the motors is configured.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import bench
import cases
import numpy as np
from loop import Loop
from verdict_flights import UNTOLD

from uav_ident_ros.client import Coefficients, CoefficientSource, Excitation, Fallback
from uav_ident_ros.control import RateController
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.excitation_run import ExcitationRun
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.aircraft import cruise_derivatives
from uav_ident_ros.simulation.faults import Fault
from uav_ident_ros.simulation.flight import EPOCH_NS
from uav_ident_ros.simulation.jsbsim_flight import LiveAircraft
from uav_ident_ros.simulation.live import Live
from uav_ident_ros.simulation.preparation import CONFIG, SENSORS
from uav_ident_ros.simulation.quadrotor_flight import Body, LiveQuadrotor
from uav_ident_ros.simulation.rate_reference import NORMAL, Manoeuvres

AIRCRAFT = "c172p"
SEVERITIES = {"calm": 0, "light": 1, "moderate": 2, "heavy": 4}
"""Severities of JSBSim's turbulence."""

START, LONGEST, AFTER = 10.0, 60.0, 2.0
"""Request of the run, its longest duration, and the time of observation after it, s."""

LEAD = 0.15
FAULT, RELEARNED, TRACKED = 50.0, 5.0, 8.0
"""Time of the motor's fault; time for its relearning; and length of the intervals, before the fault
and from two seconds after it, in which tracking is measured; s."""

LEFT = 0.7
"""Remaining share of the motor's thrust; derivatives keep three quarters plus a quarter of it."""

MEASURED = (
    "pdot/p", "pdot/da", "pdot/beta", "qdot/q", "qdot/de", "qdot/alpha", "rdot/dr", "rdot/beta",
)  # fmt: skip


Found = dict[str, Any]
"""Results of one flight."""


class Flight:
    """One flight, a sample at a time."""

    def __init__(
        self, severity: int, seed: int, name: str = AIRCRAFT, *, untold: bool = False
    ) -> None:
        nodes = ("identifier", "rate_reference", "controller")
        identified, guided, controlled = (
            dict[str, Any](load_parameters(CONFIG / f"{name}.yaml", node)) for node in nodes
        )
        identified |= {
            "excitation.lead": LEAD, "excitation.duration": LONGEST, "imu.convention": "frd"
        }  # fmt: skip
        delay = identified["actuators.delay"]
        self.aircraft: Live
        if name == AIRCRAFT:
            self.aircraft = LiveAircraft(name, SENSORS, delay, (), seed)
            self.aircraft.apply(Fault("turbulence", value=float(severity)))
        else:
            self.aircraft = LiveQuadrotor(SENSORS, delay, (), seed)
        if untold:
            identified |= UNTOLD
        self.settings = Settings.from_values(identified)
        self.identifier = OnlineIdentifier(self.settings)
        known = Coefficients.from_file(CONFIG / f"{name}_coefficients.yaml")
        trim = np.array(controlled["trim"])
        limits = np.array([controlled["least"], controlled["largest"]]) - trim
        source = CoefficientSource(Fallback.NOMINAL, known)
        controller = RateController(source, known, limits, controlled["delay"], adaptive=False)
        excitation = Excitation(controlled["excitation_limit"])
        self.run = ExcitationRun(self.identifier.structure)

        def on_estimate(estimate: Estimate) -> None:
            """Pass the requested excitation to controller and identifier."""
            self.estimate = estimate
            injection = self.run.step(self.identifier.flying(), estimate)
            if injection is not None:
                excitation.add(injection.t_ns, list(INPUTS), injection.values.tolist())
                self.identifier.add_excitation(injection.t_ns, injection.values.tolist())

        self.loop = Loop(
            self.aircraft, trim, Manoeuvres(**NORMAL | guided | {"seed": seed}),
            controller, self.identifier,
            lambda t_ns, u: controller.inject(t_ns, u, excitation.at(t_ns)), on_estimate,
        )  # fmt: skip

    def step(self) -> FloatArray:
        """Fly one sample; return rates (3), attitude (2) and tracking error (3)."""
        sample, reference = self.loop.answer()
        self.aircraft.advance()
        return np.array([*sample.rates, *sample.attitude[:2], *(sample.rates - reference)])


def fly(job: tuple[str, int, bool]) -> Found:
    """Fly a job once: severity, seed, whether excited."""
    severity, seed, excited = job
    flight = Flight(SEVERITIES[severity], seed)
    rows: list[FloatArray] = []
    ended: float | None = None
    why = ""
    while flight.aircraft.time < START + LONGEST + AFTER:
        time = flight.aircraft.time
        if excited and not why and not flight.run.active and time >= START:
            flying = flight.identifier.flying()
            why = flight.run.start(flight.settings.excitation, flying, flight.estimate)
            why = why or "running"
        row = flight.step()
        if time >= START:
            rows.append(row)
        if excited and why and not flight.run.active:
            ended = time if ended is None else ended
            if time >= ended + AFTER:
                break
    seen = np.array(rows)
    limits = flight.settings.excitation
    truth = cruise_derivatives(AIRCRAFT, flight.settings.airspeed.reference)
    true = np.array([truth[name] for name in MEASURED])
    learned = flight.identifier.coefficient_set()
    places = cases.places(flight.identifier.structure, MEASURED)
    error = learned.values[places] - true
    return {
        "severity": severity, "seed": seed, "excited": excited, "why": flight.run.why,
        "seconds": (flight.aircraft.time if ended is None else ended) - START,
        "rate": float(np.abs(seen[:, :3]).max() / limits.max_rate),
        "attitude": float(np.abs(seen[:, 3:5]).max() / limits.max_attitude),
        "tracking": np.degrees(np.sqrt(np.mean(seen[:, 5:] ** 2, axis=0))).tolist(),
        # of the dominant derivatives: relative, and in sigmas
        "errors": (error / np.abs(true)).tolist(),
        "sigmas": (error / np.maximum(learned.sigma[places], 1e-12)).tolist(),
    }  # fmt: skip


def lose_a_motor(seed: int, *, untold: bool) -> dict[str, Any]:
    """Identify the quadrotor in hover and reduce a motor's thrust; return the results."""
    flight = Flight(0, seed, "quadrotor", untold=untold)
    errors, healthy, relearned = [], None, None
    while flight.aircraft.time < FAULT + 2.0 + TRACKED:
        if not flight.run.active and not flight.run.why and flight.aircraft.time >= START:
            settings = replace(flight.settings.excitation, duration=FAULT - START - 10.0)
            flight.run.start(settings, flight.identifier.flying(), flight.estimate)
        if healthy is None and flight.aircraft.time >= FAULT:
            healthy = flight.estimate
            flight.aircraft.apply(Fault("effect", "motor_front_left", LEFT))
        if relearned is None and flight.aircraft.time >= FAULT + RELEARNED:
            relearned = flight.estimate
        errors.append(flight.step()[5:])
    start = EPOCH_NS * 1e-9 + FAULT
    changes = {c.name: c.t - start for c in flight.identifier.supervisor.changed}
    out: dict[str, Any] = {"seed": seed, "run": flight.run.why, "changes": changes}
    out["delay"], out["lag"] = flight.identifier.delay, flight.identifier.lag
    share = (len(LiveQuadrotor.names) - 1 + LEFT) / len(LiveQuadrotor.names)
    for when, estimate, left in (("before", healthy, 1.0), ("after", relearned, share)):
        assert estimate is not None
        out[when] = {
            name: float(estimate.coefficients[flight.identifier.structure.index(name)])
            / (left * true) - 1.0
            for name, true in Body().derivatives().items()
        }  # fmt: skip
    rates, count = np.degrees(np.array(errors)), round(TRACKED * SENSORS.rate)
    fault = round(FAULT * SENSORS.rate)
    parts = (rates[fault - count : fault], rates[-count:])
    out["tracking"] = [np.sqrt(np.mean(part**2, axis=0)).tolist() for part in parts]
    return out


def quadrotor_line(one: dict[str, Any]) -> str:
    """Return the line of a quadrotor's flight."""
    noticed = ", ".join(f"{name} {t:.1f} s" for name, t in one["changes"].items())
    errors = [
        " / ".join(f"{name} {100 * e:.0f}" for name, e in one[when].items())
        for when in ("before", "after")
    ]
    tracking = [" / ".join(f"{v:.1f}" for v in part) for part in one["tracking"]]
    return (
        f"seed {one['seed']}: {one['run']}; delay {1e3 * one['delay']:.0f} ms, "
        f"lag {1e3 * one['lag']:.0f} ms; errors before {errors[0]} %, {RELEARNED:g} s after "
        f"{errors[1]} %; noticed: {noticed}; rms p / q / r {tracking[0]}, from the third "
        f"second on {tracking[1]} deg/s"
    )


HEAD = (
    "turbulence", "excited", "rate, of the limit", "attitude, of the limit", "left", "ends, s",
    "aborted", "rms p / q / r, deg/s", "worst error, % (median, largest)", "within 2 sigma",
)  # fmt: skip


def rows(found: list[Found]) -> Iterator[Sequence[str]]:
    """Yield the rows of the table."""
    for (severity, excited), some in bench.grouped(found, "severity", "excited").items():
        rate, attitude, seconds, tracking, errors, sigmas = (
            np.array([f[name] for f in some])
            for name in ("rate", "attitude", "seconds", "tracking", "errors", "sigmas")
        )
        left = np.sum(np.maximum(rate, attitude) > 1.0)
        aborted = sum(f["why"].startswith("aborted") for f in some)
        worst = 100.0 * np.abs(errors).max(axis=1)
        yield (
            severity, "yes" if excited else "no", f"{max(rate):.2f}", f"{max(attitude):.2f}",
            f"{left} of {len(some)}", f"{np.median(seconds):.0f}", f"{aborted}",
            " / ".join(f"{axis:.2f}" for axis in tracking.mean(axis=0)),
            f"{np.median(worst):.0f}, {max(worst):.0f}",
            f"{100.0 * np.mean(np.abs(sigmas) <= 2.0):.0f} %",
        )  # fmt: skip


def main() -> None:
    """Fly and print."""
    output = bench.BUILD / "excitation.json"
    parser = bench.parser(__doc__, seeds=20, workers=2, output=output)
    parser.add_argument("--excited", action="store_true", help="leave out the flights without")
    parser.add_argument("--severity", choices=tuple(SEVERITIES), action="append")
    parser.add_argument("--quadrotor", action="store_true", help="a motor that fails instead")
    parser.add_argument("--untold", action="store_true", help="configure no delay and lag")
    options = parser.parse_args()
    if options.quadrotor:
        lost = partial(lose_a_motor, untold=options.untold)
        bench.done(lost, range(options.seeds), options.workers, quadrotor_line)
        return
    jobs = [
        (severity, seed, excited)
        for severity in options.severity or SEVERITIES
        for seed in range(options.seeds)
        for excited in ((True,) if options.excited else (False, True))
    ]
    found = bench.done(fly, jobs, options.workers, lambda one: f"{one['severity']}: {one['why']}")
    bench.keep(options.output, found)
    print(*bench.table(HEAD, rows(found)), sep="\n")


if __name__ == "__main__":
    main()
