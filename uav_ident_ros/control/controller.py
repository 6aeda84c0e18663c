# SPDX-License-Identifier: Apache-2.0
"""A rate controller on identified coefficients, without ROS: samples in, inputs out."""

import numpy as np

from uav_ident_ros.client import Coefficients, CoefficientSource, History
from uav_ident_ros.control.choice import IDENTIFIED, AxisChoice, Effect
from uav_ident_ros.control.effectiveness import Effectiveness
from uav_ident_ros.control.lateness import DelayMeter
from uav_ident_ros.control.laws import MAX_INTERVAL, Gains, IncrementalLaw, InversionLaw
from uav_ident_ros.control.response import Response
from uav_ident_ros.control.sideslip import rolls_over, yaw_for_roll
from uav_ident_ros.identification.samples import NS, NS_PER_S
from uav_ident_ros.identification.structure import INPUTS, FloatArray

Law = type[IncrementalLaw] | type[InversionLaw]

LONGEST_HOLD = 1.0
"""Longest gap of the Imu during which the last inputs are assumed to act, s: they hold the trim.
After a longer gap another controller may have flown the aircraft."""

LAWS: dict[str, Law] = {"incremental": IncrementalLaw, "inversion": InversionLaw}
"""Control laws, by name."""


class RateController:
    """Adaptive rate controller: from a gyro sample to the inputs."""

    def __init__(
        self,
        # Source of the identified sets; `Fallback.LAST_GOOD` or `NOMINAL`, with the nominal set
        source: CoefficientSource,
        nominal: Coefficients,  # The author's own set
        # (2, 4) Lower and upper limits of de, dr, da, dth from trim; the throttle is not used
        limits: FloatArray,
        # Delay from a sample's stamp to the motion of the surface, s; an adaptive controller
        # replaces it by the measured delay
        delay: float,
        law: Law = IncrementalLaw,
        # Whether to use identified and measured derivatives, or always the nominal set
        adaptive: bool = True,
        gains: Gains | None = None,  # Gains of the law; its defaults if None
    ) -> None:
        self._limits = limits
        limits = np.array(limits, dtype=np.float64)
        limits[:, INPUTS.index("dth")] = 0.0
        self._source = source
        self._choice = AxisChoice(source, nominal, limits, adaptive)
        self._adaptive, self._yaw_for_roll = adaptive, yaw_for_roll(nominal)
        self._last_ns = 0
        self._rolled_over = False
        # Inputs of the last command, which act during a gap, and those of the law alone
        self._newest = self._of_law = np.zeros(4)
        self._commands: History[FloatArray] = History()
        self._references: History[FloatArray] = History()
        self._response = Response()
        # Measured control effectiveness and delay of the inputs
        self.effectiveness, self.delay = Effectiveness(), DelayMeter(delay)
        # Control derivatives in use, and their sources
        self.effect: Effect = self._choice.update(0, self.effectiveness)
        self._law = law(limits, self._choice.scale, gains or law.gains)

    def update(
        self,
        t_ns: int,  # Stamp of the sample, ns
        x: FloatArray,  # x, reference: (3,) Measured and wanted p, q, r, rad/s, FRD
        reference: FloatArray,
    ) -> FloatArray:
        """Return de, dr, da, dth, deviations from trim.

        A sample or a reference that is not finite leaves them unchanged: it would stay in the
        filters for ever.
        """
        if not (np.isfinite(x).all() and np.isfinite(reference).all()):
            return self._of_law
        dt, before_ns = (t_ns - self._last_ns) * NS, self._last_ns
        self._last_ns = t_ns
        if not 0.0 < dt < MAX_INTERVAL:
            if dt > LONGEST_HOLD:
                self._newest = np.zeros(4)
            dt, before_ns = 0.0, t_ns
            self._restart(t_ns, x, reference)
        if dt > 0.0 and self._adaptive:
            self._measure(before_ns, dt, x)
        self._references.add(t_ns, reference)
        self.effect = self._choice.update(t_ns, self.effectiveness)
        if isinstance(self._law, IncrementalLaw):
            yaw = self._yaw_for_roll if self._must_sideslip(t_ns, x) else 0.0
            held = self._acting(before_ns, self.delay.delay)
            u = self._law.update(dt, self.effect.values, x, reference, held, yaw)
        else:
            model, acting = self._source.model(t_ns), self._acting(t_ns, self.delay.delay)
            u = self._law.update(dt, model, self.effect.values, x, reference, acting)
        self._of_law = self._sent(t_ns, u)
        return u

    def _must_sideslip(self, t_ns: int, x: FloatArray) -> bool:
        """Whether to roll by sideslip: from a predicted roll-over until the ailerons work again.

        Ailerons that lose half of their effect in a roll look dead for an instant: a usable row, or
        an answer of the aircraft meanwhile, contradicts that. A row may become usable with dead
        ailerons, too, if they stand at a stop: they look like a constant moment.
        """
        measured = self.effectiveness
        works = self.effect.sources[0] == IDENTIFIED or measured.recovering[0]
        if not (measured.dead[0] and self._adaptive):
            self._rolled_over = False
        elif not (self._rolled_over or works):
            newest = self._source.newest(t_ns)
            flow = None if newest is None else newest.flow
            model = self._choice.model
            damping = float(model.values[model.structure.index("pdot/p")])
            rolling = float(x[0]), float(self._response.acceleration[0]), damping
            self._rolled_over = flow is None or rolls_over(flow.roll, *rolling)
        return self._rolled_over

    def _measure(self, before_ns: int, dt: float, x: FloatArray) -> None:
        """Update the measured effectiveness and delay by the `dt` s since the last sample."""
        inputs = np.array([self._acting(before_ns, delay) for delay in self.delay.delays])
        delayed_reference = self._references.at(before_ns - round(self.delay.delay * NS_PER_S))
        response, choice = self._response, self._choice
        if not response.update(x, choice.measured_by, inputs, dt, choice.model, delayed_reference):
            return
        share = self.effect.share
        if self.delay.update(response.answered, response.made * share, response.acceleration, dt):
            for axis in range(len(x)):
                self.effectiveness.changed(axis)
            choice.discard_measured()
        delay, rival = self.delay.in_use, self.delay.rival
        self.effectiveness.update(
            response.answered[delay],
            response.made[delay],
            dt,
            response.demanded,
            share,
            None if rival is None else (response.answered[rival], response.made[rival]),
        )

    def _acting(self, t_ns: int, delay: float) -> FloatArray:
        """Return the inputs that act from `t_ns` until the next sample, shape (4,)."""
        u = self._commands.at(t_ns - round(NS_PER_S * delay))
        return np.zeros(4) if u is None else u

    def inject(self, t_ns: int, u: FloatArray, excitation: FloatArray) -> FloatArray:
        """Return the inputs `u` of `t_ns` plus an excitation, within the limits.

        The law receives the sum, so that the excitation is no disturbance.
        """
        if not excitation.any():
            return u
        return self._sent(t_ns, np.clip(u + excitation, *self._limits))

    def _sent(self, t_ns: int, u: FloatArray) -> FloatArray:
        self._newest = u
        self._commands.add(t_ns, u)
        return u

    def _restart(self, t_ns: int, x: FloatArray, reference: FloatArray) -> None:
        self._commands, self._references = History(), History()
        self._commands.add(0, self._newest)
        self.effectiveness.restart()
        self._response.restart()
        self.delay.restart()
        if isinstance(self._law, IncrementalLaw):
            self._law.restart(x, reference, self._newest)
        else:
            self._law.restart(self._source.model(t_ns), self.effect.values, x, reference)
