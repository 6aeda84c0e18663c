# SPDX-License-Identifier: Apache-2.0
"""Advice on a replay: each piece is the text of one function of the evidence."""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from uav_ident_ros.files.meanings import AXIS_INPUT_WORDS, AXIS_WORDS, INPUT_WORDS, MEANINGS
from uav_ident_ros.identification.samples import ACTUATORS
from uav_ident_ros.identification.speed import unmeasured
from uav_ident_ros.identification.structure import CONSTANT, INPUTS, MAIN_INPUTS, RATES, ROWS
from uav_ident_ros.offline.evidence import ROW_FORCES, Evidence

MAIN_NAMES: Mapping[str, str] = {
    name: f"{row}/{name}" for name in INPUTS for row, own in MAIN_INPUTS.items() if own == name
}
"""Main control derivative of each surface; throttle has none."""

STILL = 1e-9
"""Standard deviation of an input below which it has not moved, in its own unit."""

DELAY_OFF = 0.02
"""Difference between the delay in use and the estimated one that is reported, s: the fit loses a
point or two for each 10 ms."""

DELAY_SIGMAS = 3.0
"""Sigmas from the delay in use at which a trial of an estimate that is not sure is advised."""

FORCE_SHARE = 0.15
"""Share of a row's residual that a specific force must explain to be advised as a regressor."""

FEW_POINTS = 20.0
"""Points of the fit that are not reported: a gain by measured forces, which a controller does not
have, or a loss relative to a perfect fit."""

LARGEST_NOISE = 0.1
"""Gyro noise from which the least-squares start is poor in any flight, rad/s: 6 deg/s."""

NOISE_SHARE = 0.3
"""Gyro noise over the standard deviation of the rate from which the excitation is too weak."""

SLOW_IMU = 49.0
"""Rate of the Imu, Hz: below 50 (less a little jitter) the samples do not resolve the roll mode."""

SLOW_ACTUATORS = 24.0
"""Rate of the actuators, Hz: below 25 their motion between the samples is unknown."""

FAST_LOGS = (
    "PX4: SDLOG_PROFILE bit 4, 'high rate'; ArduPilot: LOG_BITMASK bits 0, 'fast attitude', and "
    "18, 'fast IMU', of a Copter, 13, 'RC input-output', and 19, 'raw IMU', of a Plane"
)
"""Settings for fast logs of an autopilot; the tables of import_logs have them in detail."""

EXCITED_BY = {
    True: "an autopilot's autotune does that, and ArduPilot's SystemID mode (SID_AXIS)",
    False: "doublets by hand without stabilisation do that, and PX4's autotune, not ArduPlane's",
}
"""Sources of suitable excitation, of a multirotor and of an aircraft with surfaces."""

DROPPED_SHARE = 0.01
"""Share of dropped messages that is reported."""

SIGN_SIGMAS = 3.0
"""t-ratio from which a wrong sign is significant."""

SHORT_FLIGHT = 60.0
"""Duration below which cross couplings are hardly identified, s."""

GROUNDED = ("not armed", "no message says that it is armed", "not flying", "at rest")
"""First words of the reasons of an aircraft that does not fly."""

GROUNDED_SHARE = 0.9
"""Share of the ticks on the ground from which a bag is no flight."""

LOST_SHARE = 0.3
"""Share of the ticks lost to one gate that is reported."""

OFF_TRIM = 0.25
"""Median of an input in its standard deviations from which it is off its trim: a moment that is not
in the model is then a quarter of the input's, as much as a verdict allows."""

DAMPING_DERIVATIVES = ("pdot/p", "qdot/q", "rdot/r")


class Advice(NamedTuple):
    """A piece of advice."""

    name: str  # Name of its function, for programs
    text: str  # Problem, evidence and cure, for people


def never_flew(e: Evidence) -> Iterator[str]:
    """Yield advice if the aircraft did not fly in nearly all of the bag, or was not armed."""
    reasons = {r: share for r, share in e.lost.items() if r.startswith(GROUNDED)}
    if sum(reasons.values()) > GROUNDED_SHARE:
        yield (
            f"the aircraft hardly flew: {100.0 * sum(reasons.values()):.0f} % of the time "
            f"{', '.join(reasons)}; take a flight, or correct 'armed.type' or 'airspeed.type'"
        )


def contradiction(e: Evidence) -> Iterator[str]:
    """Yield the contradiction between signals and settings, such as a gyro in deg/s."""
    if e.contradiction:
        yield e.contradiction


def no_excitation(e: Evidence) -> Iterator[str]:
    """Yield advice if no surface moved: then there is no model to judge."""
    actuators = e.streams.get(ACTUATORS)
    if actuators and actuators.received == sum(actuators.dropped.values()):
        yield (
            "no message of the actuators could be used: the effects of the surfaces are unknown; "
            "look at 'actuators.type', 'actuators.channels' and the stamps"
        )
    elif (e.input_spread[: INPUTS.index("dth")] < STILL).all():
        multirotor = e.settings.actuators.multirotor
        what = "roll, pitch or yaw input" if multirotor else "surface"
        yield (
            f"no {what} moved: their effects are unknown; check 'actuators.channels' and "
            f"'actuators.mixing', or excite the aircraft: {EXCITED_BY[multirotor]}"
        )


def gated(e: Evidence) -> Iterator[str]:
    """Yield the reasons that prevented learning for a large part of the flight."""
    for reason, share in e.lost.items():
        if share > LOST_SHARE and not reason.startswith(GROUNDED):
            setting = e.gate_settings.get(reason)
            see = f" (see '{setting}')" if setting else ""
            yield f"nothing was learned in {100.0 * share:.0f} % of the flight: {reason}{see}"


def weak_excitation(e: Evidence) -> Iterator[str]:
    """Yield the surfaces of the vehicle that moved too little to identify their derivatives."""
    multirotor, needed = e.settings.actuators.multirotor, e.settings.supervision.min_t_ratio
    names = AXIS_INPUT_WORDS if multirotor else INPUT_WORDS
    for name, derivative in MAIN_NAMES.items():
        if not e.settings.actuators.has(name):
            continue
        word, ratio = names[name], e.t_ratio(derivative, setup=False)
        if e.input_spread[INPUTS.index(name)] < STILL:
            yield f"the {word} never moved: its effect is unknown; move it"
        elif ratio is not None and ratio < needed:
            answers = float(e.answers[INPUTS.index(name)])
            cure = f"; move the {word} more, and by itself"
            if answers > 0.0:
                cure = (
                    f", since {100.0 * answers:.0f} % of its motion answers disturbances; move the "
                    f"{word} by itself, whatever the aircraft does: {EXCITED_BY[multirotor]}"
                )
            yield (
                f"not enough {word} excitation: {derivative} is known to {ratio:.1f} sigma only "
                f"({needed:g} needed){cure}"
            )


def wrong_setup(e: Evidence) -> Iterator[str]:
    """Yield the settings that are off and widen sigma, without the delay if it has other advice."""
    delay_problem, _, _ = e.delay.contradiction(e.delay_in_use).partition(": ")  # without the cure
    has_other = any([*wrong_delay(e), *wrong_lag(e)])
    for reason in dict.fromkeys(filter(None, e.setup)):
        if not (has_other and reason.startswith(delay_problem)):
            yield reason


def wrong_delay(e: Evidence) -> Iterator[str]:
    """Yield the problem, as in the verdict, if the estimated delay contradicts the one in use."""
    if abs(e.delay.off(e.delay_in_use)) <= DELAY_OFF or e.delay.lag_off(e.lag_in_use):
        return
    is_held = e.actuator_rate > 0.0 and e.settings.actuators.interpolation != "linear"
    problem = e.delay.contradiction(e.delay_in_use, 0.5 / e.actuator_rate if is_held else 0.0)
    also = ", or 'actuators.estimate_delay' to true" if "set 'actuators.delay'" in problem else ""
    yield f"{problem}{also}"


def wrong_lag(e: Evidence) -> Iterator[str]:
    """Yield advice if the lag of the response to injected signals contradicts the one in use."""
    in_use = e.lag_in_use
    if off := e.delay.lag_off(in_use):
        lag = in_use + off
        yield (
            f"the injected signal shows a servo lag of {1e3 * lag:.0f} ms (sigma "
            f"{1e3 * e.delay.lag_sigma:.0f} ms), {1e3 * in_use:.0f} ms are in use: set "
            f"'actuators.time_constant' to {lag:.3f} and 'actuators.delay' to "
            f"{max(e.delay.total - lag, 0.0):.3f}, or 'actuators.estimate_delay' to true"
        )


def unknown_delay(e: Evidence) -> Iterator[str]:
    """Yield advice if the delay is to be estimated, and the estimate is not sure."""
    if not e.settings.actuators.estimate_delay or e.delay.sure:
        return
    if e.delay.delay - e.delay_in_use > DELAY_SIGMAS * e.delay.sigma:
        yield (
            f"the inputs seem to act {1e3 * e.delay.delay:.0f} ms (sigma {1e3 * e.delay.sigma:.0f} "
            f"ms) after their stamps, {1e3 * e.delay_in_use:.0f} ms are in use: that is not sure "
            f"enough to be taken over; replay with 'actuators.delay' {e.delay.delay:.3f}, and keep "
            "it if the fit is better"
        )
    else:
        found = (
            f"{1e3 * e.delay.delay:.0f} ms, sigma {1e3 * e.delay.sigma:.0f} ms"
            if math.isfinite(e.delay.sigma)
            else "no estimate"
        )
        if e.delay.delay < -DELAY_SIGMAS * e.delay.sigma:
            found += ": they seem to follow the motion, as an autopilot's answers do, or are late"
        yield (
            f"the flight does not show the delay of the inputs ({found}; "
            f"{1e3 * e.delay_in_use:.0f} ms in use), and a wrong one falsifies every control "
            "derivative: step the surfaces without feedback, as 3-2-1-1 inputs do, or measure the "
            "delay on the ground and set 'actuators.delay'"
        )


def row_needs_force(e: Evidence) -> Iterator[str]:
    """Yield the rows whose residual a specific force would explain, as a regressor."""
    for row, share in e.force_share.items():
        if share > FORCE_SHARE:
            yield (
                f"the {AXIS_WORDS[row]} row needs {ROW_FORCES[row]}: it explains "
                f"{100.0 * share:.0f} % of what is left over; set 'structure' to 'augmented'"
            )


def leans_on_force(e: Evidence) -> Iterator[str]:
    """Yield the axes with a much higher fit with measured forces."""
    points = [
        f"{axis}: {measured - free:.0f} ({ROW_FORCES[row]})"
        for row, axis, measured, free in zip(
            ROWS, RATES, e.fit.measured_force, e.fit.model, strict=True
        )
        if measured - free > FEW_POINTS
    ]
    if points:
        yield (
            "the predictions lean on specific forces, which a controller does not know ahead: with "
            f"the measured ones the fit is higher, in points, {', '.join(points)}"
        )


def noisy_gyro(e: Evidence) -> Iterator[str]:
    """Yield the axes with a high gyro noise, absolute or relative to the rates flown.

    With a slow Imu, differences of samples are motion and no measure of noise.
    """
    if 0.0 < e.imu_rate < SLOW_IMU:
        return
    for axis, noise, spread in zip(RATES, e.gyro_noise, e.rate_spread, strict=True):
        if noise > LARGEST_NOISE:
            yield (
                f"gyro noise high: {noise:.2g} rad/s on {axis}; damp the mounting, or let the "
                "sensor filter it"
            )
        elif noise > NOISE_SHARE * spread:
            yield (
                f"gyro noise high for so gentle a flight: {noise:.2g} rad/s on {axis}, which "
                f"moved by {spread:.2g} rad/s; excite it more"
            )


def slow_streams(e: Evidence) -> Iterator[str]:
    """Yield the streams whose message rate is too low."""
    slow = [
        f"of the {word} come at {rate:.0f} Hz: {needed + 1.0:.0f} Hz are needed"
        for word, rate, needed in (
            ("Imu", e.imu_rate, SLOW_IMU),
            ("actuators", e.actuator_rate, SLOW_ACTUATORS),
        )
        if 0.0 < rate < needed
    ]
    if slow:
        yield f"the messages {', those '.join(slow)} ({FAST_LOGS})"


def many_drops(e: Evidence) -> Iterator[str]:
    """Yield the streams with dropped messages."""
    for stream, refusals in e.streams.items():
        dropped = sum(refusals.dropped.values())
        if dropped > DROPPED_SHARE * refusals.received:
            of = f"{dropped} of {refusals.received} messages of the {stream}"
            yield f"{of} were dropped: {refusals.text}"


def assumed_airspeed(e: Evidence) -> Iterator[str]:
    """Yield advice if the airspeed is neither measured nor set."""
    if problem := unmeasured(e.settings):
        yield problem


def wrong_sign(e: Evidence) -> Iterator[str]:
    """Yield the damping derivatives that are significantly positive."""
    for name in DAMPING_DERIVATIVES:
        ratio = e.t_ratio(name)
        if ratio is not None and ratio > SIGN_SIGMAS and e.values[e.structure.index(name)] > 0.0:
            yield (
                f"{MEANINGS[name]} ({name}) is positive, which drives the motion: look at the "
                "signs of the axes ('imu.convention', 'imu.rpy') and at 'actuators.delay'"
            )


def off_trim(e: Evidence) -> Iterator[str]:
    """Yield the inputs that are off their trim, if the structure has no constant moment."""
    if CONSTANT in e.structure.regressors:
        return
    ratios = e.input_median / np.where(e.input_spread < STILL, np.inf, e.input_spread)
    off = [f"{n} by {r:+.1f}" for n, r in zip(INPUTS, ratios, strict=True) if abs(r) > OFF_TRIM]
    if off:
        yield (
            f"in the median of the flight the inputs are off their trim ({', '.join(off)} standard "
            f"deviations), and {e.structure.name} has no constant moment for that: set "
            "'actuators.trim' to the median of each channel, or 'actuators.learn_trim_time'"
        )


def short_flight(e: Evidence) -> Iterator[str]:
    """Yield advice if the flight is too short to identify cross couplings."""
    if e.duration < SHORT_FLIGHT:
        yield f"the flight is short, {e.duration:.0f} s: excite it for two minutes"


def no_better_than_holding(e: Evidence) -> Iterator[str]:
    """Yield the axes whose rate the model predicts no better than holding it."""
    explained = any(any(cause(e)) for cause in (slow_streams, gated, weak_excitation))
    look = "" if explained else ": look at the delay, the signs and the channels first"
    for axis, model, hold in zip(RATES, e.fit.model, e.fit.hold, strict=True):
        if model <= hold:
            yield (
                f"{axis} is predicted no better ({model:.0f} %) than by holding it ({hold:.0f} %)"
                f"{look}"
            )


def collinear_groups(e: Evidence) -> Iterator[str]:
    """Yield the groups of collinear coefficients with a main control derivative."""
    groups = [g for g in e.collinear if any(name in MAIN_NAMES.values() for name in g)]
    if groups:
        listed = "; ".join(" and ".join(group) for group in groups)
        yield (
            f"only a combination is known of {listed}: move each input when the others are still"
        )


ROOT_CAUSES: tuple[Callable[[Evidence], Iterator[str]], ...] = (
    never_flew,
    contradiction,
    no_excitation,
)
"""Advice on bags without a model, or with a wrong one: no other advice on it applies."""

ADVICE: tuple[Callable[[Evidence], Iterator[str]], ...] = (
    *ROOT_CAUSES,
    slow_streams,
    gated,
    weak_excitation,
    wrong_setup,
    off_trim,
    wrong_delay,
    wrong_lag,
    unknown_delay,
    assumed_airspeed,
    wrong_sign,
    no_better_than_holding,
    row_needs_force,
    leans_on_force,
    noisy_gyro,
    many_drops,
    short_flight,
    collinear_groups,
)
"""All advice: causes before their effects, but see `advise`."""

OF_THE_BAG = (slow_streams, many_drops, short_flight)
"""Advice that applies without a model, too."""


def advise(evidence: Evidence) -> tuple[Advice, ...]:
    """Return the advice on a replay, causes before their effects."""
    pieces = list(ADVICE)
    if 100.0 - float(np.fmax.reduce(evidence.fit.model)) < FEW_POINTS:
        # slow messages are minor if the best axis has nearly a perfect fit
        pieces.sort(key=lambda piece: piece is slow_streams)
    if root := [cause for cause in ROOT_CAUSES if any(cause(evidence))]:
        pieces = [root[0], *OF_THE_BAG]
    return tuple(Advice(find.__name__, text) for find in pieces for text in find(evidence))
