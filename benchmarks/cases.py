# SPDX-License-Identifier: Apache-2.0
"""Flights as the identifier's input, one pass over them, and its score."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice, takewhile
from typing import Any

import flights
import numpy as np
from bench import ACTUATORS_TOPIC, AIRSPEED_TOPIC, RATES_TOPIC, ROOT
from numpy.typing import NDArray

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.identification.estimate import CoefficientSet, Estimate
from uav_ident_ros.identification.estimators import Estimator, make_estimator
from uav_ident_ros.identification.frames import BodyFrame
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.prediction import (
    Flown,
    InputSignal,
    PredictionFit,
    Published,
    WindowErrors,
    score_windows,
    window_errors,
)
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.samples import ACTUATORS, AIRSPEED, EXCITATION
from uav_ident_ros.identification.sampling import Block, InputMap, Sampler
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES, BoolArray, FloatArray, Structure
from uav_ident_ros.messages.feed import IMU_TYPE
from uav_ident_ros.messages.types import RATE_ADAPTERS
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.noise import Measurements, Samples, SentSample, fed
from uav_ident_ros.simulation.recording import parameters

TimeArray = NDArray[np.int64]

RECORDED = ROOT.parent / "shared" / "bags"
"""Folder of recorded real flights; cases of a missing one are omitted."""

AIRSPEED_TYPE = "std_msgs/msg/Float64"
TOPICS = (RATES_TOPIC, ACTUATORS_TOPIC, AIRSPEED_TOPIC)
"""Topics of the recorded flights."""

RECORDED_DELAY = {
    "thor75_auto": 0.08,
    "thor75_flight": 0.08,
    "proto_flt09": 0.0,
    "skywalker_manual": 0.0,
}
"""Transport delay of the recorded flights, s; 0 if unknown."""

RECORDED_SPEED = 17.0
"""Usual airspeed of the recorded aircraft, m/s."""

LAST_PART = "last_40_percent"

MODELS: Mapping[str, Mapping[str, object]] = {
    "paper (20)": {"structure": "throttle_coupled"},
    "+ constant": {
        "structure": "augmented",
        "fixed_coefficients": ("pdot/ay", "qdot/az", "rdot/ay"),
    },
    "+ ay, az": {"structure": "augmented"},
}
"""Settings of the compared structures, by label."""

DOMINANT = ("pdot/p", "qdot/q", "rdot/r", "pdot/da", "qdot/de", "rdot/dr")
"""Roll, pitch, yaw damping; aileron, elevator, rudder."""

PRIMARY = {"elevator": "qdot/de", "aileron": "pdot/da", "rudder": "rdot/dr"}
"""Main control derivative of each surface."""


@dataclass(frozen=True, eq=False)
class Case:
    """Messages of a flight and the settings for them."""

    parameters: dict[str, Any]  # Settings for its topics
    samples: Samples  # The received samples

    @property
    def flight(self) -> Flight | None:
        """The noise-free record; None of a recorded flight."""
        return self.samples.flight if isinstance(self.samples, Measurements) else None

    def messages(
        self,
        identifier: OnlineIdentifier,  # The receiver; the airspeed only if its type is set
        given: Iterable[FloatArray] = (),  # Published excitation, one for each actuator sample
    ) -> Iterator[SentSample]:
        """Yield the messages in the order of arrival."""
        excitation = iter(given)
        for message in self.samples.messages():
            if message.stream != AIRSPEED or identifier.settings.airspeed.type:
                yield message
            if message.stream == ACTUATORS:
                for added in islice(excitation, 1):
                    yield message._replace(stream=EXCITATION, values=tuple(added.tolist()))

    def settings(self, values: Mapping[str, object]) -> Settings:
        """Return the settings for the topics, with `values`."""
        return Settings.from_values({**self.parameters, **values})

    def measured(self, settings: Settings) -> tuple[FloatArray, FloatArray]:
        """Return p, q, r (N, 3) and ay, az (N, 2), FRD."""
        frame = BodyFrame(settings.imu)
        m = self.samples
        return frame.to_body(m.rates), frame.to_body(m.specific_force)[:, 1:]

    def blocks(self, settings: Settings, given: FloatArray | None = None) -> list[Block]:
        """Return the signals on the identifier's grid, a block between restarts.

        `given` is the published excitation, (M, 4), at the actuators' samples.
        """
        sampler, m = Sampler(settings), self.samples
        sampler.rates.t, sampler.rates.v = m.imu_t_ns, np.hstack([m.rates, m.specific_force])
        sampler.raw_inputs.t, sampler.raw_inputs.v = m.actuator_t_ns, m.actuators
        if given is not None:
            sampler.injected.t, sampler.injected.v = m.actuator_t_ns, given
        return list(sampler.blocks())


def measured(m: Measurements) -> Case:
    """Return the case of a simulated flight's measurements."""
    return Case(parameters(m), m)


def is_recorded(name: str) -> bool:
    """Return whether there is a recorded flight of that name."""
    return (RECORDED / name).is_dir()


@lru_cache(maxsize=2)
def recorded(name: str) -> Case:
    """Return a recorded real flight."""
    read = RATE_ADAPTERS[IMU_TYPE].read
    received: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
    log_ns: dict[str, list[int]] = {topic: [] for topic in TOPICS}
    with Bag(RECORDED / name) as bag:
        decode = {topic: bag.decoder(topic) for topic in TOPICS if topic in bag.types}
        for message in bag.messages(decode):
            received[message.topic].append(decode[message.topic](message.data))
            log_ns[message.topic].append(message.log_ns)
    stamps, rates, forces, *_ = zip(*map(read, received[RATES_TOPIC]), strict=True)
    imu_ns, sent_ns, spoken = (np.array(log_ns[topic], dtype=np.int64) for topic in TOPICS)
    sent_ns, first = np.unique(sent_ns, return_index=True)
    known = {
        "actuators.channels": (0, 1, 2, 3),
        "actuators.delay": RECORDED_DELAY.get(name, 0.0),
        "airspeed.reference": RECORDED_SPEED,
    }
    samples = Samples(
        imu_t_ns=np.array(stamps, dtype=np.int64),
        imu_log_ns=imu_ns,
        rates=np.array(rates),
        specific_force=np.array([force or (0.0, 0.0, 0.0) for force in forces]),
        actuator_t_ns=sent_ns,
        actuator_log_ns=sent_ns,
        actuators=np.array([list(m.data) for m in received[ACTUATORS_TOPIC]])[first],
        airspeed_t_ns=spoken,
        airspeed_log_ns=spoken,
        airspeed=np.array([m.data for m in received[AIRSPEED_TOPIC]]),
    )
    return Case(known, samples)


def load(name: str, seed: int | None = None) -> Case:
    """Return a recorded flight, or one of `flights.yaml`; arguments are those of `flights.load`."""
    return recorded(name) if name in RECORDED_DELAY else measured(flights.load(name, seed))


@dataclass(frozen=True, eq=False)
class Track:
    """Result of one pass over a flight."""

    settings: Settings  # Settings of the pass
    t_ns: TimeArray  # (K,) Ticks, ns
    time: FloatArray  # (K,) The same in s after the first Imu sample
    # coefficients, sigma: (K, 3, n) Estimate and standard deviation at each
    coefficients: FloatArray
    sigma: FloatArray
    estimates: Sequence[Estimate]  # All of the estimate at each
    # (K, 3) Rows that learned, and rows whose fit is below that of holding the rate
    learning: BoolArray
    losing: BoolArray
    delay: FloatArray  # (K,) Delay in use, s
    changes: list[tuple[float, str]]  # Covariance resets: time, s, and coefficient
    flow: FloatArray | None = None  # As in `Published`

    def constant(self, coefficients: FloatArray) -> Track:
        """Return the same ticks with constant coefficients."""
        still = np.broadcast_to(coefficients, self.coefficients.shape)
        return replace(self, coefficients=still)

    def published(self) -> Published:
        """Return the track as published coefficients."""
        return Published(self.t_ns, self.coefficients, self.structure, self.flow)

    @property
    def structure(self) -> Structure:
        """Structure of the coefficients."""
        return STRUCTURES[self.settings.structure]

    def at(self, time: float) -> int:
        """Index of the last tick at or before `time`, s."""
        return int(np.searchsorted(self.time, time + 1e-6, side="right")) - 1


def identify(
    case: Case,  # The flight
    values: Mapping[str, object],  # Settings besides those for its topics
    make: Callable[[Settings, Start], Estimator] = make_estimator,  # That of the settings
    *,
    initial: CoefficientSet | None = None,  # Initial coefficients
    given: Iterable[FloatArray] = (),  # Published excitation, as in `Case.messages`
    until: float = np.inf,  # End of the pass after the first sample, s
) -> Track:
    """Run the identifier once over a flight, as the node does."""
    settings = case.settings(values)
    identifier = OnlineIdentifier(settings, initial, estimator=make)
    m = case.samples
    start = int(m.imu_t_ns[0])
    end = m.imu_log_ns[-1] if np.isinf(until) else start + round(until * 1e9)
    estimates, learning, losing, delays = [], [], [], []
    messages = case.messages(identifier, given)
    for estimate in fed(identifier, takewhile(lambda m: m.arrival_ns <= end, messages)):
        estimates.append(estimate)
        learning.append(identifier.supervisor.learning)
        losing.append(estimate.fit < identifier.running_fit.hold)
        delays.append(identifier.delay)
    t_ns = np.array([estimate.t_ns for estimate in estimates], dtype=np.int64)
    return Track(
        settings=settings,
        t_ns=t_ns,
        time=(t_ns - start) * 1e-9,
        coefficients=np.array([estimate.coefficients for estimate in estimates]),
        sigma=np.array([estimate.sigma for estimate in estimates]),
        estimates=estimates,
        learning=np.array(learning),
        losing=np.array(losing),
        delay=np.array(delays),
        changes=[(c.t - start * 1e-9, c.name) for c in identifier.supervisor.changed],
        flow=Published.of(estimates, identifier.structure).flow,
    )


def places(structure: Structure, names: Iterable[str]) -> tuple[Any, ...]:
    """Return rows and columns of named coefficients."""
    return tuple(np.transpose([structure.index(name) for name in names]))


def given_force(fit: PredictionFit) -> FloatArray:
    """Return the fit with measured forces if there is one, else the free fit."""
    return np.where(np.isnan(fit.measured_force), fit.model, fit.measured_force)


def score(case: Case, track: Track, rates: FloatArray | None = None) -> PredictionFit:
    """Score a track over the last 40 %, as `replay` does: each window with the delay at its start.

    The reference is the measured rates, or `rates` at the same times, (N, 3).
    """
    measured, force = case.measured(track.settings)
    rates = measured if rates is None else rates
    actuators, m = track.settings.actuators, case.samples
    u = InputMap(actuators).apply(m.actuators)
    first, last = int(m.imu_t_ns[0]), int(m.imu_t_ns[-1])
    late = track.t_ns >= last - round(0.4 * (last - first))  # only these windows count
    parts = []
    for delay in np.unique(track.delay[late]):
        chosen = late & (track.delay == delay)
        parts.append(
            window_errors(
                Flown(
                    m.imu_t_ns,
                    rates,
                    InputSignal(m.actuator_t_ns, u, float(delay), actuators.time_constant),
                    force,
                    np.array(track.settings.imu.lever_arm),
                ),
                track.published().chosen(chosen),
            )
        )
    return score_windows(WindowErrors.join(parts), first, last)[LAST_PART]


def truth_in(structure: Structure, flight: Flight, time: float = 0.0) -> FloatArray:
    """Return the true coefficients of a plant in another structure, shape (3, n)."""
    own = STRUCTURES[flight.structure]
    true = flight.coefficients_at(time)
    out = np.zeros(structure.mask.shape)
    for name, (i, j) in own.places.items():
        if name in structure.names:
            out[structure.index(name)] = true[i, j]
    return out
