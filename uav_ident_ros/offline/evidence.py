# SPDX-License-Identifier: Apache-2.0
"""Measured quantities of a replayed flight, the basis of the advice."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from uav_ident_ros.identification.delay import NO_ESTIMATE, DelayEstimate
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.prediction import Flown, PredictionFit
from uav_ident_ros.identification.regression import StateVariableFilter
from uav_ident_ros.identification.samples import NS, TimeArray
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import INPUTS, ROWS, STRUCTURES, FloatArray, Structure
from uav_ident_ros.offline.run import PAUSE_NS, OfflineRun, Refusals

FULL = STRUCTURES["augmented"]
FIT_WINDOWS = "last_40_percent"

ROW_FORCES: Mapping[str, str] = {"pdot": "ay", "qdot": "az", "rdot": "ay"}
"""The specific force that replaces the flow angle of each row."""

_DIFFERENCE_NOISE = 20.0**0.5
"""Standard deviation of the third difference of white noise, in units of that of the noise."""

_NUMBER = re.compile(
    r"(?<![A-Za-z_\d])(?<![A-Za-z_\d]-)[-+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?(?!\d|\.\d|-[a-z])"
)
"""Numbers in a reason, but not those of a name (1-second, REP-103): reasons that differ in their
numbers alone are the same."""

_NORMAL_MEDIAN = 0.6745
"""Median of the magnitude of a normal deviate, in units of its standard deviation."""


@dataclass(frozen=True)
class Evidence:
    """Measured quantities of a replay."""

    settings: Settings  # Settings in use
    structure: Structure  # Structure of the coefficients
    # values, sigma: (3, n) Coefficients and their standard deviations
    values: FloatArray
    sigma: FloatArray
    fit: PredictionFit  # Score of record over the last part of the flight
    duration: float  # Time from the first to the last rates, s
    rate_spread: FloatArray  # (3,) Standard deviation of p, q, r, rad/s
    gyro_noise: FloatArray  # (3,) Standard deviation of the gyro's white noise, rad/s
    input_spread: FloatArray  # (4,) Standard deviation of de, dr, da, dth
    # imu_rate, actuator_rate: Median rates of the messages, Hz; 0 if there are too few
    imu_rate: float
    actuator_rate: float
    # (4,) Median of de, dr, da, dth: zero if the trim is that of this flight
    input_median: FloatArray = field(default_factory=lambda: np.zeros(len(INPUTS)))
    delay: DelayEstimate = NO_ESTIMATE  # Estimate of the transport delay
    delay_in_use: float = 0.0  # Delay in use at the end, s
    lag_in_use: float = 0.0  # Servo lag in use at the end, s
    # For rows without their specific force: the share of the residual that the force would explain
    force_share: Mapping[str, float] = field(default_factory=dict)
    collinear: tuple[tuple[str, ...], ...] = ()  # Groups of collinear coefficients
    # Share of the ticks at which a gate was closed, for each reason, the largest first
    lost: Mapping[str, float] = field(default_factory=dict)
    # Setting of the gate of each reason
    gate_settings: Mapping[str, str] = field(default_factory=dict)
    # (3, n) Standard deviations without the bias of settings that are off, and the error, by row
    scatter: FloatArray | None = None
    setup: tuple[str, ...] = ()
    contradiction: str = ""  # Between signals and settings, with its cure; empty if there is none
    # (4,) Share of each input's motion that is feedback of disturbances, significantly
    answers: FloatArray = field(default_factory=lambda: np.zeros(len(INPUTS)))
    # Counts of received and dropped messages of each stream
    streams: Mapping[str, Refusals] = field(default_factory=dict)

    def t_ratio(self, name: str, *, setup: bool = True) -> float | None:
        """Return the t-ratio of a coefficient; None if it is fixed or not of the structure.

        Without `setup`, sigma is without the bias of settings that are off.
        """
        if name not in self.structure.names:
            return None
        index = self.structure.index(name)
        sigma = self.sigma if setup or self.scatter is None else self.scatter
        spread = float(sigma[index])
        return abs(float(self.values[index])) / spread if spread > 0.0 else None


def gather(run: OfflineRun, fits: Mapping[str, PredictionFit]) -> Evidence:
    """Return the evidence of a replay with at least one estimate."""
    identifier, result = run.identifier, run.result()
    flown = run.flown()
    inputs = flown.inputs.u if len(flown.inputs.u) else np.zeros((1, len(INPUTS)))
    flown_ns = int(flown.t_ns[-1] - flown.t_ns[0]) - PAUSE_NS * len(run.restarts)
    return Evidence(
        settings=run.inputs.settings,
        structure=run.structure,
        values=result.values,
        sigma=result.sigma,
        fit=fits[FIT_WINDOWS],
        duration=flown_ns * NS,
        rate_spread=flown.rates.std(axis=0),
        gyro_noise=gyro_noise(flown.rates),
        input_spread=inputs.std(axis=0),
        imu_rate=_rate(flown.t_ns),
        actuator_rate=_rate(flown.inputs.t_ns),
        input_median=np.median(inputs, axis=0),
        delay=identifier.delays.estimate,
        delay_in_use=identifier.delay,
        lag_in_use=identifier.lag,
        force_share=_force_share(run, flown),
        collinear=tuple(identifier.estimator.information.collinear()),
        lost=lost_to(run.estimates),
        gate_settings={
            _NUMBER.sub("…", cost.reason): cost.setting
            for cost in identifier.supervisor.gates.costs().values()
        },
        scatter=identifier.estimator.sigma.copy(),
        setup=tuple(identifier.setup_doubts),
        contradiction=identifier.plausibility.fault,
        answers=identifier.estimator.answers.copy(),
        streams={name: run.refusals(name) for name in run.inputs.streams},
    )


def lost_to(estimates: Sequence[Estimate]) -> dict[str, float]:
    """Return the share of the ticks at which nothing was learned, for each reason.

    Reasons that differ in their numbers alone count together; the largest share comes first.
    """
    reasons = Counter(reason_of(e) for e in estimates if not e.adapting)
    return {reason: count / len(estimates) for reason, count in reasons.most_common()}


def reason_of(estimate: Estimate) -> str:
    """Return the reason not to learn at a tick, without its numbers; empty if there is none."""
    return "" if estimate.adapting else _NUMBER.sub("…", estimate.reason)


def gyro_noise(rates: FloatArray) -> FloatArray:
    """Estimate the white noise of evenly sampled rates (k, 3), same unit, from third differences.

    The motion of an aircraft hardly contributes at 50 Hz and more; vibration does.
    """
    differences = np.diff(rates, n=3, axis=0)
    if not len(differences):
        return np.zeros(differences.shape[1])
    usual = [np.median(column) for column in np.abs(differences).T]
    return np.array(usual) / _NORMAL_MEDIAN / _DIFFERENCE_NOISE


def _rate(t_ns: TimeArray) -> float:
    """Return the median rate of stamps, Hz; 0 if there are fewer than two."""
    return 1.0 / (float(np.median(np.diff(t_ns))) * NS) if len(t_ns) > 1 else 0.0


def _force_share(run: OfflineRun, flown: Flown) -> dict[str, float]:
    """Return the share of each row's residual that its specific force as a regressor would explain.

    Residuals are those of least squares on the filtered signals.
    """
    settings, structure = run.inputs.settings, run.structure
    if structure.size >= FULL.size:
        return {}
    products: FloatArray = np.zeros((FULL.size + len(ROWS),) * 2)
    whole = None
    for block in run.blocks(flown.inputs):
        cutoff = settings.filter.cutoff
        whole = whole or StateVariableFilter(FULL, cutoff, block.h, flown.lever_arm)
        data = whole.apply(block)
        signals = np.hstack([data.f, data.y])
        products += signals.T @ signals

    def residual(row: int, columns: list[int]) -> float:
        """Return the residual sum of squares of a row's acceleration on some columns."""
        y = FULL.size + row
        vector = products[columns, y]
        solution = np.linalg.lstsq(products[np.ix_(columns, columns)], vector, rcond=None)[0]
        return max(float(products[y, y] - vector @ solution), 0.0)

    shares = {}
    for i, (row, force) in enumerate(ROW_FORCES.items()):
        present = [*np.flatnonzero(structure.mask[i]), FULL.regressors.index("1")]
        left = residual(i, present)
        with_force = residual(i, [*present, FULL.regressors.index(force)])
        shares[row] = 1.0 - with_force / left if left > 0.0 else 0.0
    return shares
