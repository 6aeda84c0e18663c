# SPDX-License-Identifier: Apache-2.0
"""What the signal conditioning must show: ``python benchmarks/conditioning.py [NAME ...]``.

Filtered least squares on simulated flights of known truth, measured in every way that must not
matter, and on the recorded flight. Fits are 1-second prediction fits against the noise-free
rates over the last 40 % of the flight, at the true times and with the true inputs, so that they
tell what the coefficients are worth and not how they were measured. The table goes to the
terminal, the figures to ``build/conditioning.json``; the exit status is 1 if a figure falls
short of what is asked.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy loads

import cases
import flights
import numpy as np

from uav_ident_ros.identification.prediction import Flown, InputSignal, score
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray

BUILD = flights.ROOT / "build"
RECORDED = "thor75_auto"

LINEAR = (
    "pdot/p", "pdot/r", "pdot/dr", "pdot/da", "qdot/q", "qdot/de",
    "rdot/p", "rdot/r", "rdot/dr", "rdot/da",
)  # fmt: skip
"""Coefficients of rates and surfaces."""

LOCAL = ("pdot/da", "pdot/p", "qdot/de", "qdot/q")
"""Those whose local truth the specific forces do not shift."""

VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "as FRD": {"convention": "frd"},
    "50 Hz": {"rate": 50.0},
    "100 Hz": {"rate": 100.0},
    "1000 Hz": {"rate": 1000.0},
    "20 % dropped": {"drop": 0.2},
    "5 ms stamp jitter": {"stamp_jitter": 0.005},
    "unstamped": {"stamped": False},
    "unstamped, 2 ms latency": {"stamped": False, "latency": 0.002},
}
"""Ways to measure a flight that must not matter: fields of `Sensors`."""

REPORTED = ("unstamped, 2 ms latency",)
"""Of these, those that are only reported: stamps on arrival are good to some milliseconds, and
what an aircraft without any delay makes of an input that seems to come late is no defect of the
conditioning."""

NOISE_FREE = {"gyro_noise": 0.0, "accelerometer_noise": 0.0}
ARM = (1.0, 0.0, 0.0)
"""Accelerometer a metre ahead of the centre of gravity."""


@dataclass(frozen=True)
class Row:
    """One figure."""

    # section, what: What was measured
    section: str
    what: str
    value: tuple[float, ...]  # The figures
    unit: str  # Their unit
    wanted: str = ""  # What is asked; empty if the figure is only reported
    met: bool = True  # Whether it is met


@dataclass(frozen=True, eq=False)
class Outcome:
    """A pass over a flight."""

    track: cases.Track
    fit: FloatArray

    def coefficients(self, names: Iterable[str]) -> FloatArray:
        a = self.track.coefficients[-1]
        return np.array([a[self.track.structure.index(name)] for name in names])

    def sigma(self, names: Iterable[str]) -> FloatArray:
        a = self.track.sigma[-1]
        return np.array([a[self.track.structure.index(name)] for name in names])


def run(
    name: str,
    values: Mapping[str, object] | None = None,
    seed: int | None = None,
    until: float = np.inf,
    **sensors: Any,
) -> Outcome:
    """Identify a flight by filtered least squares and score it."""
    case = cases.simulated(name, seed, **sensors)
    own = {"estimator": "least_squares", **(values or {})}
    track = cases.identify(case, own, until=until)
    return Outcome(track, np.full(3, np.nan) if until < np.inf else true_fit(name, track, seed))


def true_fit(name: str, track: cases.Track, seed: int | None = None) -> FloatArray:
    """Fit of p, q, r against the noise-free rates at 200 Hz, percent."""
    m = flights.load(name, seed, rate=200.0)
    flown = Flown(
        m.true_t_ns,
        m.true_rates,
        InputSignal(
            m.flight.actuator_t_ns,
            m.flight.inputs,
            m.flight.delay,
            m.flight.time_constant,
            "hold",
        ),
        m.flight.force_at((0.0, 0.0, 0.0))[:: round(m.flight.rate / 200.0), 1:],
    )
    fits = score(flown, track.published())
    return np.asarray(fits[cases.LAST_PART].model)


def floats(values: Any) -> tuple[float, ...]:
    return tuple(float(v) for v in np.atleast_1d(values))


# -- how it is measured --------------------------------------------------------------------


def invariance() -> Iterable[Row]:
    """Measure one JSBSim flight in different ways."""
    section = "how it is measured (c172p_calm)"
    clean, noisy = run("c172p_calm", **NOISE_FREE), run("c172p_calm")
    yield Row(section, "200 Hz FLU, no noise: fit", floats(clean.fit), "%")
    yield Row(section, "200 Hz FLU, noise 0.02: fit", floats(noisy.fit), "%")
    for label, sensors in VARIANTS.items():
        for noise, reference in ((NOISE_FREE, clean), ({}, noisy)):
            got = run("c172p_calm", **{**noise, **sensors})
            for row in _compare(section, label, bool(noise), got, reference):
                yield replace(row, wanted="", met=True) if label in REPORTED else row


def _compare(
    section: str, label: str, is_clean: bool, got: Outcome, reference: Outcome
) -> Iterable[Row]:
    name = f"{label}, {'no noise' if is_clean else 'noise 0.02'}"
    lost = np.abs(got.fit - reference.fit)
    yield Row(section, f"{name}: fit moved by", floats(lost), "%", "2", bool(lost.max() <= 2.0))
    base, new = reference.coefficients(LINEAR), got.coefficients(LINEAR)
    apart = 100.0 * np.abs(new / base - 1.0)
    worst = int(np.argmax(apart))
    if is_clean:
        yield Row(
            section, f"{name}: worst linear, {LINEAR[worst]}", floats(apart[worst]), "%", "5",
            bool(apart[worst] <= 5.0),
        )  # fmt: skip
        return
    # Other noise: a coefficient can agree to no more than its own standard deviation.
    spread = np.hypot(got.sigma(LINEAR), reference.sigma(LINEAR))
    excess = np.maximum(np.abs(new - base) - 2.0 * spread, 0.0) / np.abs(base)
    yield Row(
        section, f"{name}: worst linear, {LINEAR[worst]}; beyond two sigma",
        floats([apart[worst], 100.0 * excess.max()]), "%", "5 or two sigma",
        bool(np.all((apart <= 5.0) | (excess == 0.0))),
    )  # fmt: skip


# -- the exact plant -----------------------------------------------------------------------


def exact() -> Iterable[Row]:
    """Identify a plant of the structure itself, whose truth is known."""
    section = "exact plant, 60 s"
    for structure in ("throttle_coupled", "augmented"):
        clean = run("exact_calm", {"structure": structure}, until=60.0)
        names = _linear_of("exact_calm")
        error = _worst_error("exact_calm", clean, names)
        yield Row(
            section, f"{structure}, no noise: worst linear", (error,), "%", "0.5", error <= 0.5
        )
        errors = [
            _worst_error(
                "exact_noise_002",
                run("exact_noise_002", {"structure": structure}, seed, 60.0),
                cases.DOMINANT,
            )
            for seed in (1, 2, 3)
        ]
        yield Row(
            section, f"{structure}, noise 0.02: worst dominant, three seeds", floats(errors), "%",
            "5", max(errors) <= 5.0,
        )  # fmt: skip


def _linear_of(name: str) -> list[str]:
    structure = STRUCTURES[flights.load_flight(name).structure]
    return [n for n, (_, j) in zip(structure.names, structure.free, strict=True) if j >= 5]


def _worst_error(name: str, got: Outcome, names: Sequence[str]) -> float:
    truth = cases.truth_in(got.track.structure, flights.load_flight(name))
    true = np.array([truth[got.track.structure.index(n)] for n in names])
    return float(100.0 * np.abs(got.coefficients(names) / true - 1.0).max())


def channel_sets() -> Iterable[Row]:
    """Raw channels of other vehicles on the same plant."""
    section = "channels (exact_noise_002)"
    plain = run("exact_noise_002", until=60.0).coefficients(_linear_of("exact_noise_002"))
    for channels in ("elevon", "quadrotor", "pwm"):
        got = run("exact_noise_002", until=60.0, channels=channels)
        apart = np.abs(got.coefficients(_linear_of("exact_noise_002")) / plain - 1.0).max()
        yield Row(
            section, f"{channels}: worst linear against plain", floats(100.0 * apart), "%", "0.1",
            bool(apart <= 1e-3),
        )  # fmt: skip


# -- JSBSim --------------------------------------------------------------------------------


def aircraft() -> Iterable[Row]:
    """Identify a nonlinear aircraft, with and without the specific forces as regressors."""
    wanted = np.array([95.0, 85.0, 91.0])
    for name in ("c172p_calm", "c172p_banked"):
        section = f"{name}, noise 0.02"
        best = run(name)
        yield from _aircraft_rows(section, "augmented", name, best, wanted)
        paper = run(name, {"structure": "throttle_coupled"})
        yield Row(section, "paper's structure: fit", floats(paper.fit), "%")
        given = run(name, lever_arm=ARM)
        yield from _aircraft_rows(section, "1 m ahead, arm given", name, given, wanted)
        ignored = run(name, {"imu.lever_arm": (0.0, 0.0, 0.0)}, lever_arm=ARM)
        yield Row(section, "1 m ahead, arm not given: fit", floats(ignored.fit), "%")


def _aircraft_rows(
    section: str, label: str, name: str, got: Outcome, wanted: FloatArray
) -> Iterable[Row]:
    yield Row(
        section, f"{label}: fit", floats(got.fit), "%", "95 85 91", bool(np.all(got.fit >= wanted))
    )
    truth = flights.load_flight(name).local_truth
    apart = 100.0 * (got.coefficients(LOCAL) / [truth[n] for n in LOCAL] - 1.0)
    yield Row(
        section, f"{label}: {' '.join(LOCAL)} against local truth", floats(apart), "%", "10",
        bool(np.abs(apart).max() <= 10.0),
    )  # fmt: skip


# -- the delay -----------------------------------------------------------------------------


def delays() -> Iterable[Row]:
    """Find the delay where the flight shows it, and only there."""
    section = "delay"
    found = run("c172p_delay", {"actuators.delay": 0.0, "actuators.estimate_delay": True})
    track = found.track
    at_30 = 1e3 * track.delay[track.at(30.0)]
    first = float(track.time[int(np.argmax(track.delay > 0.0))])
    yield Row(section, "c172p_delay, 60 ms: first used at", (first,), "s")
    yield Row(
        section, "c172p_delay, 60 ms: in use at 30 s", floats(at_30), "ms", "60 +- 10",
        bool(abs(at_30 - 60.0) <= 10.0),
    )  # fmt: skip
    calm = run("c172p_calm")
    lost = calm.fit - found.fit
    yield Row(
        section, "fit lost against the undelayed flight", floats(lost), "%", "1",
        bool(lost.max() <= 1.0),
    )  # fmt: skip
    ignored = run("c172p_delay", {"actuators.delay": 0.0})
    yield Row(section, "fit with the delay ignored", floats(ignored.fit), "%")
    for name in ("c172p_unexcited", "t37_unexcited"):
        kept = run(name, {"actuators.delay": 0.04, "actuators.estimate_delay": True})
        used = 1e3 * kept.track.delay[-1]
        yield Row(section, f"{name}, set to 40 ms: in use", floats(used), "ms", "40", used == 40.0)
    if cases.is_recorded(RECORDED):
        values = {
            "actuators.delay": 0.0,
            "actuators.estimate_delay": True,
            "actuators.interpolation": "linear",
        }
        used = 1e3 * cases.identify(cases.recorded(RECORDED), values).delay[-1]
        yield Row(
            section, f"{RECORDED}: in use", floats(used), "ms", "70 ... 80",
            bool(70.0 <= used <= 80.0),
        )  # fmt: skip


SECTIONS: Mapping[str, Callable[[], Iterable[Row]]] = {
    "invariance": invariance,
    "exact": exact,
    "channels": channel_sets,
    "aircraft": aircraft,
    "delay": delays,
}


def line(row: Row) -> str:
    values = " ".join(f"{v:8.2f}" for v in row.value)
    verdict = "" if not row.wanted else f"  asked {row.wanted}: {'met' if row.met else 'SHORT'}"
    return f"  {row.what:<78}{values} {row.unit}{verdict}"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="conditioning.py", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(SECTIONS))
    parser.add_argument("--output", type=Path, default=BUILD, help="folder of the results")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in SECTIONS]
    if unknown:
        parser.error(f"there is no '{unknown[0]}': write {', '.join(SECTIONS)}")
    rows: list[Row] = []
    section = ""
    for name in options.names or SECTIONS:
        for row in SECTIONS[name]():
            if row.section != section:
                section = row.section
                print(section)
            print(line(row), flush=True)
            rows.append(row)
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "conditioning.json"
    content = json.dumps([asdict(row) for row in rows], indent=1, default=bool)  # NumPy's too
    path.write_text(content, encoding="utf-8")
    return 0 if all(row.met for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
