# SPDX-License-Identifier: Apache-2.0
"""The identification pipeline: samples in, estimates out.

It has no access to ROS, files or a clock: time is passed in, as integer nanoseconds. The same
samples give the same estimates, bit for bit, however they were batched.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from uav_ident_ros.identification.delay import NO_ESTIMATE, DelayBank, DelayEstimate
from uav_ident_ros.identification.estimate import CoefficientSet, Estimate
from uav_ident_ros.identification.estimators import Estimator, make_estimator
from uav_ident_ros.identification.estimators.estimator import SecondEstimator
from uav_ident_ros.identification.estimators.model_error import known_inputs
from uav_ident_ros.identification.excitation_run import Flying
from uav_ident_ros.identification.flow import FlowObserver
from uav_ident_ros.identification.frames import BodyFrame
from uav_ident_ros.identification.gates import Gate, Look, Outliers, grounded
from uav_ident_ros.identification.model import ParallelModel
from uav_ident_ros.identification.plausibility import Plausibility, SetupErrors, clock_step
from uav_ident_ros.identification.prior import Start, resumed, start_from, without_flow
from uav_ident_ros.identification.regression import (
    BackwardDifference,
    Regression,
    StateVariableFilter,
)
from uav_ident_ros.identification.samples import (
    ACTUATORS,
    AIRSPEED,
    ARMED,
    EXCITATION,
    NO_TICK,
    NS,
    RATES_STREAM,
    Drop,
    Intake,
    SampleBuffer,
)
from uav_ident_ros.identification.sampling import Block, Sampler, join
from uav_ident_ros.identification.scales import (
    INDEPENDENT_TIME,
    LOOK_TIME,
    SAMPLE_TIME,
    START_TIME,
    SURE,
)
from uav_ident_ros.identification.settings import Settings, SettingsError, declarations
from uav_ident_ros.identification.speed import SpeedScaling
from uav_ident_ros.identification.structure import (
    MAIN_DERIVATIVES,
    ROWS,
    STRUCTURES,
    BoolArray,
    FloatArray,
)
from uav_ident_ros.identification.supervision import JUDGED_FROM, RunningFit, State, Supervisor

STRETCH_TIME = 4.0 * SAMPLE_TIME
"""Duration of the samples in one update, s: the cost of an update hardly depends on their number.
The trim is estimated later by half of it. This costs 0.3 points of the fit of recorded flights, and
less of simulated ones. Samples of an Imu slower than `SAMPLE_TIME` are used at once."""

START_LEAK_TIME = 0.5 * INDEPENDENT_TIME
"""Time constant of the leak until `START_TIME`, s: with poor coefficients rate products diverge."""


class OnlineIdentifier:
    """Online identification of the attitude dynamics.

    Parameters
    ----------
    settings : Settings
        All settings.
    initial : CoefficientSet, optional
        Initial coefficients; they take precedence over those in the settings.
    estimator : callable, optional
        Makes the estimator from the settings and the start. It replaces the configured one.
    gates : sequence of Gate
        Additional gates, beside those of `gates.Gates`.

    Attributes
    ----------
    settings : Settings
        All settings, including changes made in flight.
    intake : Intake
        Received samples, counts of dropped ones, and the tick that is due.
    sampler : Sampler
        Rates and inputs on one grid; the map from raw channels to inputs, and the trim in use.
    plausibility : Plausibility
        Contradictions between signals and settings.
    supervisor : Supervisor
        Gates, weights of the rows, changes detected in flight, and the verdict.
    estimator : Estimator
        Update law of the coefficients, with the information collected so far.
    delays : DelayBank
        Estimate of the transport delay, whether it is used or not.
    running_fit : RunningFit
        1-second prediction fit of the coefficients, of those saved, and of holding the rate.
    idle : float
        Time since the last update of the coefficients, s: inputs are missing, or a gate is closed.

    Raises
    ------
    SettingsError
        If the settings contradict each other or `initial`.

    See Also
    --------
    uav_ident_ros.offline.run.run_over : The same over a bag.
    uav_ident_ros.client.CoefficientSource : The receiver of what is published.

    References
    ----------
    S. A. Salman, A. G. Sreenatha, J. Y. Choi, "Attitude dynamics identification of unmanned
    aircraft vehicle", International Journal of Control, Automation and Systems, 2006: the model and
    the law of `gradient`. docs/algorithm.md has all equations, in the order of the code.

    Examples
    --------
    An aircraft with a roll damping of -6 1/s and an aileron of 40 1/s^2 per rad:

    >>> values = {"structure": "throttle_coupled", "imu.convention": "frd"}
    >>> identifier = OnlineIdentifier(Settings.from_values(values))
    >>> p, keep = 0.0, math.exp(-6.0 * 0.01)
    >>> for k in range(1, 4001):  # 40 s at 100 Hz; stamps in ns
    ...     aileron = 0.05 * math.copysign(1.0, math.sin(0.02 * k))
    ...     identifier.add_actuators(k * 10_000_000, [0.0, 0.0, aileron, 0.0])
    ...     identifier.add_rates(k * 10_000_000, [p, 0.0, 0.0])
    ...     p = keep * p + (1.0 - keep) * 40.0 / 6.0 * aileron
    >>> estimate = identifier.update(k * 10_000_000)
    >>> for name in ("pdot/p", "pdot/da"):
    ...     print(name, round(estimate.coefficients[identifier.structure.index(name)], 1))
    pdot/p -6.0
    pdot/da 40.0
    >>> estimate.usable_rows  # Elevator and rudder have not moved
    (True, False, False)
    """

    def __init__(
        self,
        settings: Settings,
        initial: CoefficientSet | None = None,
        *,
        estimator: Callable[[Settings, Start], Estimator] = make_estimator,
        gates: Sequence[Gate] = (),
    ) -> None:
        self._make_estimator = estimator
        self.settings = settings
        self.structure = STRUCTURES[settings.structure]
        self._initial = initial
        self._frame = BodyFrame(settings.imu)
        self.sampler = Sampler(settings)
        self._as_paper = settings.filter.method == "backward_difference"
        self._armed = SampleBuffer(1)
        self._saved: FloatArray | None = None
        self.intake = Intake(settings, self.restart)
        self.supervisor = Supervisor(settings, self.structure, gates)
        self._fresh: SecondEstimator[Estimator] | None = None
        self.reset()

    def reset(self) -> None:
        """Start cold: clear buffers and filters, and return to the initial coefficients."""
        self._begin(start_from(self.settings, self._initial))

    def resume(
        self, saved: CoefficientSet, delay: float | None = None, lag: float | None = None
    ) -> None:
        """Start warm: like `reset`, but from the coefficients of an earlier flight.

        Parameters
        ----------
        saved : CoefficientSet
            Coefficients of that flight; `resumed` increases their standard deviations. Fixed
            coefficients keep their initial value.
        delay : float, optional
            Transport delay estimated in that flight, s; used if the delay is estimated.
        lag : float, optional
            Servo lag estimated in that flight, s; used likewise.

        Raises
        ------
        SettingsError
            If `saved` does not fit the settings.
        """
        cold = start_from(self.settings, self._initial)
        warm = start_from(self.settings, resumed(saved))
        start = replace(warm, values=np.where(warm.free, warm.values, cold.values))
        self._begin(start, delay, lag)
        self.note_saved(saved)

    def reconfigure(self, settings: Settings) -> None:
        """Replace the settings; to be called between two ticks.

        Raises
        ------
        SettingsError
            If a setting that cannot change in flight differs; all settings then stay.
        """
        before, after = self.settings.values(), settings.values()
        changed = [s for s in declarations() if before[s.name] != after[s.name]]
        for setting in changed:
            if setting.read_only:
                raise SettingsError(f"'{setting.name}' cannot change in flight: start anew")
        self.settings = settings
        self.supervisor.settings = settings
        self._warm = self._is_warm()
        if any(setting.restarts for setting in changed):
            # A warm start: the coefficients were learned from signals conditioned differently.
            given = {setting.name for setting in changed}
            learned, saved = self.coefficient_set(), self._saved
            delay = None if "actuators.delay" in given else self.delay
            lag = None if "actuators.time_constant" in given else self.lag
            self.sampler = Sampler(settings)
            self.resume(learned, delay, lag)
            self._saved = saved
        else:
            self.estimator.reconfigure(settings)
            self._fresh = None
        self._news = True

    def _begin(self, start: Start, delay: float | None = None, lag: float | None = None) -> None:
        """Discard all data and begin from the prior."""
        actuators = self.settings.actuators
        if delay is None or not actuators.estimate_delay:
            delay = actuators.delay
        if lag is None or not actuators.estimate_delay:
            lag = actuators.time_constant
        self._start = start
        self.estimator: Estimator = self._make_estimator(self.settings, self._start)
        self._warm = self._is_warm()
        self._speed = SpeedScaling(self.settings.airspeed, self.structure)
        self.sampler.delay, self.sampler.time_constant = delay, lag
        self.delays = DelayBank(actuators.longest_delay, lag)
        arm = np.array(self.settings.imu.lever_arm)
        self._parallel = ParallelModel(self.structure, arm)
        self._flow: FlowObserver | None = None  # Without flow angles
        if self.structure.has_flow:
            cutoff, speed = self.settings.filter.cutoff, self.settings.airspeed.reference
            self._flow = FlowObserver(self.structure, cutoff, speed)
        self._has_accelerometer: bool | None = None
        self.running_fit = RunningFit(self.structure, self._parallel.model)
        self._saved = None
        self.supervisor.reset()
        self.plausibility = Plausibility(self.settings)
        self.intake.buffers = {
            RATES_STREAM: self.sampler.rates,
            ACTUATORS: self.sampler.raw_inputs,
            AIRSPEED: self._speed.samples,
            ARMED: self._armed,
            EXCITATION: self.sampler.injected,
        }
        self.intake.fault = ""
        self._setup_errors = SetupErrors(self.structure, self.settings.airspeed.reference)
        self._learned_time = self.idle = 0.0
        self._drifted = False  # Whether it has learned from a wrong attitude, by a gyro bias
        self.restart()

    def _is_warm(self) -> bool:
        """Whether the prior has control derivatives that the flight has not contradicted."""
        return self.estimator.start.inputs_known(self.settings.supervision.min_t_ratio)

    def restart(self) -> None:
        """Begin a new time base: clear buffers and filters, keep the coefficients."""
        self.sampler.restart()
        self._speed.restart()
        self._armed.clear()
        self.supervisor.gates.restart()
        self.plausibility.restart()
        self._outliers = Outliers()
        self.intake.restart()
        self._filter: StateVariableFilter | None = None
        # Blocks to learn from together. Of each: whether to learn, to score, and `injected`
        self._parts: list[Block] = []
        self._flags = (False, False, False)
        self._news = True
        self._paper = BackwardDifference(self.structure)
        self.running_fit.restart()
        self._looked_ns = self._fed_ns = NO_TICK

    # -- the delay of the inputs -----------------------------------------------------------

    @property
    def delay(self) -> float:
        """Transport delay in use, s: configured or estimated."""
        return self.sampler.delay

    @property
    def lag(self) -> float:
        """Servo lag in use, s: configured or estimated."""
        return self.sampler.time_constant

    @property
    def delay_estimate(self) -> DelayEstimate:
        """Estimate that the delay in use follows; without data for the configured delay."""
        return self.delays.estimate if self.settings.actuators.estimate_delay else NO_ESTIMATE

    @property
    def _flown(self) -> FloatArray:
        """Coefficients at the airspeed flown, (R, n)."""
        return self.estimator.coefficients * self._speed.scale

    def _adopt_delay(self, block: Block) -> None:
        """Adopt the delay and lag estimated with a block, if they differ from those in use.

        Information collected with another delay is biased, by tens of percent for 60 ms. It holds
        the coefficients until new data arrive, with the weight of `INDEPENDENT_TIME` of flight.
        """
        sampler, actuators = self.sampler, self.settings.actuators
        looked = self.delays.add(block, sampler.delay, bool(self.estimator.learning.any()))
        if not looked or not actuators.estimate_delay:
            return
        estimate, before = self.delays.estimate, (sampler.delay, sampler.time_constant)
        if lag_off := estimate.lag_off(sampler.time_constant):
            sampler.time_constant += lag_off
            self.delays = DelayBank(actuators.longest_delay, sampler.time_constant, self.delays)
            sampler.delay = max(self.delays.estimate.delay, 0.0)
        elif estimate.sure:
            sampler.delay = max(sampler.delay + estimate.off(sampler.delay), 0.0)
        if (sampler.delay, sampler.time_constant) != before:
            self.estimator.forget(min(INDEPENDENT_TIME / self._learned_time, 1.0))
            self._learned_time = 0.0

    def flying(self) -> Flying:
        """Return the flight state at the last tick."""
        roll, pitch = (None, None) if self._flow is None else self._flow.attitude
        rates, speed = self.sampler.rates.v[-1:, :3], self._speed
        return Flying(
            self._frame.to_body(rates[0]) if len(rates) else None,
            roll,
            pitch,
            airspeed=speed.newest,
            grounded=grounded(self.settings, self.supervisor.armed, speed.newest) or speed.silence,
        )

    @property
    def speed_believed(self) -> bool:
        """Whether the speed scaling is valid."""
        return self._speed.believed

    # -- samples in ------------------------------------------------------------------------
    #
    # Each returns the reason why the sample was dropped, or None if it was accepted. A value holds
    # from its stamp on, which is in ns.

    def add_rates(
        self, t_ns: int, pqr: Sequence[float], specific_force: Sequence[float] | None = None
    ) -> Drop | None:
        """Add one sample of the rates, in the Imu's own axes.

        Parameters
        ----------
        t_ns : int
            Stamp, ns.
        pqr : sequence of 3 floats
            Angular velocity, rad/s.
        specific_force : sequence of 3 floats, optional
            Specific force, m/s^2; taken as zero if not measured.
        """
        force = (0.0, 0.0, 0.0) if specific_force is None else specific_force
        return self.intake.add_rates(t_ns, pqr, force)

    def add_actuators(self, t_ns: int, values: Sequence[float]) -> Drop | None:
        """Add one sample of the raw channels, in the order of ``actuators.channels``."""
        return self.intake.add(ACTUATORS, t_ns, values)

    def add_airspeed(self, t_ns: int, airspeed: float) -> Drop | None:
        """Add one sample of the true airspeed, m/s."""
        return self.intake.add(AIRSPEED, t_ns, (airspeed,))

    def add_armed(self, t_ns: int, armed: bool) -> Drop | None:
        """Add the armed state of the motors; a late sample counts from the next tick on."""
        return self.intake.add(ARMED, t_ns, (float(armed),))

    def add_excitation(
        self, t_ns: int, values: Sequence[float], *, own: bool = False
    ) -> Drop | None:
        """Add one sample of the excitation injected into the inputs, past or future.

        Parameters
        ----------
        t_ns : int
            Stamp, ns; earlier samples with a later stamp are cancelled.
        values : sequence of 4 floats
            de, dr, da, dth, in the units of the inputs.
        own : bool
            Whether the last tick requested it: it then applies to waiting ticks as well.
        """
        return self.intake.add(EXCITATION, t_ns, values, own)

    # -- ticks -----------------------------------------------------------------------------

    def advance(self) -> Iterator[Estimate]:
        """Run the due ticks one by one; yield the estimate of each."""
        while (t_ns := self.intake.due) is not None:
            if (estimate := self.update(t_ns)) is not None:
                yield estimate

    def update(self, t_ns: int) -> Estimate | None:
        """Run every tick up to and including `t_ns`, due or not.

        Parameters
        ----------
        t_ns : int
            Message time, ns.

        Returns
        -------
        Estimate or None
            The estimate of the last tick that was run; None if none was.
        """
        estimate = None
        for tick_ns in self.intake.ticks(t_ns):
            estimate = self._tick(tick_ns)
        return estimate

    def _tick(self, t_ns: int) -> Estimate:
        """Run one tick: check the signals, follow the flight, learn, judge, publish."""
        self.idle += 1.0 / self.settings.update_rate
        for buffer in self.intake.buffers.values():
            buffer.merge(t_ns)
        self._speed.update(t_ns)
        self._check_signals(t_ns)
        if self._as_paper:
            self._paper_tick(t_ns)
        else:
            for block in self.sampler.blocks():
                self._fed_ns = t_ns
                self._follow(block)
                self._gather(block)
        self._judge(t_ns)
        return self._publish(t_ns)

    def _check_signals(self, t_ns: int) -> None:
        """Check the samples of this tick: drop glitches, then evaluate plausibility and gates."""
        rates, inputs, supervisor = self.sampler.rates, self.sampler.raw_inputs, self.supervisor
        if len(self._armed.t):
            supervisor.armed = bool(self._armed.v[-1, 0])
            self._armed.trim(t_ns)
        samples, channels, settings = rates.v[:0], inputs.v[:0], self.settings
        if not self._as_paper:  # the paper's law has no gates on the signals
            new = rates.after(self._looked_ns)
            max_rate, dt = settings.supervision.max_rate, 1.0 / settings.update_rate
            found = self._outliers.find(rates.v[new:], dt, max_rate)
            for which, drop in zip(found, (Drop.GLITCH, Drop.SPIKE), strict=True):
                if which is not None:
                    rates.leave_out(which)
                    self.intake.drops[RATES_STREAM][drop] += int(which.sum())
            samples, channels = rates.v[new:], inputs.v
        while steps := self.intake.clock_steps.steps:
            self.plausibility.note(t_ns * NS, clock_step(steps.pop(0) * NS))
        if settings.supervision.plausibility:
            fresh = channels[inputs.after(self._looked_ns) :]
            self.plausibility.look(t_ns * NS, samples, fresh)
        self._looked_ns = t_ns
        look = Look(
            t_ns * NS, samples, channels, self._speed.newest, self._speed.silence,
            supervisor.armed, supervisor.adapt, self.plausibility.signal_fault, settings,
        )  # fmt: skip
        supervisor.gates.look(look)

    def _follow(self, block: Block) -> None:
        """Add attitude and flow angles, and the state of the model beside the aircraft."""
        if self._flow is not None and not self._has_accelerometer:
            self._detect_accelerometer(block)
        coefficients, leak = self._flown, self.settings.model.leak_time
        if self._flow is not None:
            shows_axes = not self.supervisor.gates.closed
            self._flow.follow(block, coefficients, self._speed.airspeed, shows_axes=shows_axes)
            if self._flow.realigned:
                self._drifted, self._fresh = True, None
                longest = self.settings.actuators.longest_delay
                self.delays = DelayBank(longest, self.lag, self.delays)
        if self._learned_time < START_TIME:
            leak = min(leak, START_LEAK_TIME)
        self._parallel.follow(block, coefficients, leak)

    def _gather(self, block: Block) -> None:
        """Learn from consecutive blocks together, as soon as they are long enough."""
        gates, early = self.supervisor.gates, self._learned_time < START_TIME
        flags = self._speed.known and not gates.closed, not gates.unreadable, block.injected
        if self._parts and (block.restarted or flags != self._flags):
            self._learn()
        self._parts.append(block)
        self._flags = flags
        length = 0.0 if early or block.h > SAMPLE_TIME else STRETCH_TIME
        if sum(part.time for part in self._parts) >= length - 0.5 * block.h:
            self._learn()

    def _learn(self) -> None:
        """Score the coefficients on data that they were not estimated from, and update them."""
        block, ticks, (learns, readable, _) = join(self._parts), len(self._parts), self._flags
        self._parts.clear()
        self._news = True
        if readable:
            saved = None if self._saved is None else self._saved * self._speed.scale
            self.running_fit.add(block, self._flown, saved)
        else:
            self.running_fit.restart()
        if self._filter is None:
            cutoff, arm = self.settings.filter.cutoff, np.array(self.settings.imu.lever_arm)
            self._filter = StateVariableFilter(self.structure, cutoff, block.h, arm)
        scale = self._speed.scale[0] if self._speed.enabled else None
        samples = self._filter.apply(block, scale, self._flown)
        if learns:
            self._estimate(samples.means(), int(block.t_ns[-1]), ticks)
            self._adopt_delay(block)

    def _estimate(self, samples: Regression, t_ns: int, ticks: int) -> None:
        """Update the coefficients with the samples of some ticks that end at `t_ns`."""
        self.idle = 0.0
        estimator, supervisor = self.estimator, self.supervisor
        if not self._learned_time:  # the information was discarded
            self._drifted, self._fresh = False, None
        self._learned_time += samples.time
        if self.settings.supervision.plausibility and not self._as_paper:
            self.plausibility.exchanged.add(samples)
        rows, white = estimator.conditioned(samples)
        weight = supervisor.weigh(rows.residual[: len(ROWS)].T, samples.time, estimator.clear)
        supervisor.confirmed.add(
            white,
            estimator.linear,
            estimator.noise.variance,
            self.settings.supervision.max_age,
            estimator.may_answer,
            restarted=samples.restarted,
        )
        estimator.delay = self.delay + self.lag
        estimator.update(samples, rows, white, weight)
        supervisor.follow(t_ns * NS, estimator, ticks)
        self._try_fresh_start(samples)
        if self.estimator.changes:
            self.running_fit.forget()
        if self.estimator.rejected:
            self._warm = self._is_warm()

    def _try_fresh_start(self, samples: Regression) -> None:
        """Replace the estimator, where it is due, by a fresh one that determines more derivatives.

        It is due for an unsuccessful cold start, and once the attitude is known to have drifted
        with a gyro bias. A wrong attitude biases the effects of the flow angles: a fresh estimator
        then needs to determine no more main control derivatives, but as many.
        """

        def identified(estimator: Estimator, t_ratio: float) -> BoolArray:
            """Return which free main control derivatives are known, (3,)."""
            found = estimator.coefficients, estimator.sigma, estimator.sure_error
            free = estimator.sigma[MAIN_DERIVATIVES] > 0.0
            return np.asarray(free & known_inputs(*found, t_ratio))

        needless = self._warm or self._as_paper or self.supervisor.proven
        if not self._drifted and (needless or identified(self.estimator, SURE).any()):
            self._fresh = None
            return
        fresh = self._fresh or SecondEstimator(self._new_estimator())
        if fresh.estimator is self.estimator:  # a single estimator was passed in
            return
        self._fresh = fresh
        fresh.add(samples, np.ones(3))
        if fresh.time < JUDGED_FROM:
            return
        needed = self.settings.supervision.min_t_ratio
        found = identified(fresh.estimator, needed)
        if self._drifted:
            if (identified(self.estimator, needed) & ~found).any():
                return
            self._adopt(fresh)
        # A wrong setting makes derivatives unknown, for the fresh estimator as well.
        elif found.any() and not any(self.setup_doubts):
            # Results from the time before belong to another state of the aircraft.
            self._adopt(fresh)
            self.delays = DelayBank(self.settings.actuators.longest_delay, self.lag)
            self.supervisor.reset()
        self._fresh = None

    def _adopt(self, fresh: SecondEstimator[Estimator]) -> None:
        """Use a fresh estimator from now on."""
        self.estimator, self._learned_time = fresh.estimator, fresh.time
        self._drifted = False
        self.running_fit.forget()

    def _new_estimator(self) -> Estimator:
        """Return an estimator without flight data; after a cold start it has weak priors."""
        start = self.estimator.start if self._drifted else self._start.weakened(self.structure)
        if self._has_accelerometer is False:
            start = without_flow(start, self.structure)
        return self._make_estimator(self.settings, start)

    def _detect_accelerometer(self, block: Block) -> None:
        """Detect the accelerometer; leave out the flow angles while there is none."""
        force, before = block.specific_force, self._has_accelerometer
        # A real accelerometer changes from sample to sample.
        self._has_accelerometer = bool((force[1:] != force[:-1]).any())
        if before is None and not self._has_accelerometer:
            self.estimator.set_start(without_flow(self._start, self.structure))
        elif before is False and self._has_accelerometer:
            # Without flow angles their moments were attributed to other regressors.
            self._parts.clear()
            self.estimator = self._make_estimator(self.settings, self._start)
            self._learned_time = 0.0

    def coefficient_set(self, t_ns: int = 0) -> CoefficientSet:
        """Return the coefficients at the reference airspeed, to save or to start from.

        Parameters
        ----------
        t_ns : int
            Message time to record with them, ns.
        """
        return CoefficientSet(
            self.structure.name,
            self.estimator.coefficients.copy(),
            self._setup_errors.widened(self.estimator.sigma),
            t_ns,
        )

    def note_saved(self, saved: CoefficientSet) -> None:
        """Record the saved or initial set: its fit is computed beside that of the set in use."""
        self._saved = saved.values
        self.running_fit.save()

    def _paper_tick(self, t_ns: int) -> None:
        """Update by the paper's law: backward differences of the rates at the ticks."""
        held = self.sampler.held(t_ns)
        if held is None:
            return
        x, u, force = held
        dt, model = 1.0 / self.settings.update_rate, self._parallel.model
        regression = self._paper.step(t_ns, x, u, force, dt)
        if regression is None:
            model.state = x
            return
        model.euler(self.estimator.coefficients, x, u, force, dt, self.settings.model.leak_time)
        self._fed_ns, self._news = t_ns, True
        if not self.supervisor.gates.closed:
            self._estimate(regression, t_ns, 1)

    def _judge(self, t_ns: int) -> None:
        """Judge the coefficients anew if there is any news, and keep what is shown of them."""
        estimator, speed, supervision = self.estimator, self._speed, self.settings.supervision
        if self.idle > LOOK_TIME and self.supervisor.adapt:
            # Without new data the confirmation of the coefficients fades.
            self.supervisor.confirmed.fade(1.0 / self.settings.update_rate, supervision.max_age)
            self._news = True
        if self._news:
            delays, lag = self.delays.estimate, self.sampler.time_constant
            if self._warm and estimator.answers.any() and not delays.from_injected:
                # Inputs that answer gusts appear delayed; the prior takes precedence.
                delays = NO_ESTIMATE
            self._setup_errors.look(
                estimator.coefficients,
                delays,
                self.sampler.delay,
                lag,
                self.delays.lost,
                estimator.height,
                lag_is_configured=lag > 0.0 or not self.settings.actuators.estimate_delay,
                held=self.sampler.hold_delay,
            )
            self._sigma = self._setup_errors.widened(estimator.sigma)
        if self._news or speed.enabled:
            flown = self._flown
            self._shown = flown, speed.widened(self._sigma * speed.scale, flown)
        if self._news:
            if supervision.plausibility:
                gyro = self._flow.gyro if self._flow else None
                self.plausibility.judge(t_ns * NS, *self._shown, gyro)
            self.supervisor.judge(
                t_ns * NS,
                *self._shown,
                self.running_fit,
                estimator,
                self.setup_doubts,
                math.inf if self._warm else self._learned_time,
                # Coefficients known a priori have a sign, which the flight confirms.
                "" if self._warm else self.plausibility.likely_axes,
            )
        self._news = False

    @property
    def setup_doubts(self) -> list[str]:
        """For each moment row the setting that biases it beyond the verdict's limit; '' if none."""
        needed = self.settings.supervision.min_t_ratio
        return self._setup_errors.denied(self.estimator.coefficients, needed)

    def _publish(self, t_ns: int) -> Estimate:
        """Return the estimate of a tick: faults come first, then missing samples."""
        (coefficients, sigma), supervisor = self._shown, self.supervisor
        # Samples may be slower than ticks: one tick without a block does not count as waiting.
        patience = 0.0 if self._as_paper else self.settings.filter.max_gap / NS
        fed = t_ns - self._fed_ns <= patience
        if why := self.intake.fault or self.estimator.problem or self.plausibility.fault:
            state = State.FAULT
        elif not fed:
            state, why = State.WAITING, f"waiting for {self.sampler.waiting_for or 'samples'}"
        elif not self._speed.known:
            state, why = State.WAITING, "waiting for airspeed"
        else:
            state, why = supervisor.state()
        doubt = self.plausibility.doubt
        if doubt is not None and state in (State.LEARNING, State.CONVERGED):
            state, why = State.LEARNING, doubt.finding.text
        sound = state is not State.FAULT and self._speed.believed and doubt is None
        p, q, r = (sound and not reason for reason in supervisor.verdict)
        predicted = self._frame.to_imu(self._parallel.model.state[:3])
        rates = self.sampler.rates.v
        newest = rates[-1, :3] if len(rates) else np.zeros(3)
        return Estimate(
            t_ns=t_ns,
            coefficients=coefficients,
            sigma=sigma,
            predicted_rates=predicted,
            prediction_error=newest - predicted,
            flow=None if self._flow is None else self._flow.state(coefficients, sigma),
            fit=self.running_fit.fit,
            adapting=fed and True in supervisor.learning.tolist(),
            usable=p and q and r,
            usable_rows=(p, q, r),
            state=state.value,
            reason=why,
        )
