# SPDX-License-Identifier: Apache-2.0
"""Model errors: late, slow, saturated or loose inputs, an Imu above the centre of gravity.

A servo lag, a limit of travel or of speed, or a play that is not configured leaves little in the
residual, because damping absorbs most of it. Each row is therefore solved once more with additional
regressors,

    y = A f + c1 u|u| + c2 du/dt - c3 d2u/dt2 + c4 (u - b(u)) + c5 (u - s(u)),

with u the row's main input (a model error model; Ljung, System Identification, 1999, ch. 16), b(u)
the same behind a play, and s(u) behind a servo that is as slow as the rms rate of u. Against the
input's effect, c1 is saturation, c2 lateness, c3 an effect that falls with frequency, as by a servo
lag in whose place a delay is in use, c4 backlash, and c5 a limit of speed. The row's derivatives
are then off by about as much. A c2 that adds to the effect is an input that acts early: a
configured lag or delay is too long, and all derivatives may be off by several times.

An accelerometer h above the centre of gravity measures `h pdot` as side force. In the row of ay,
with p in the place of u, c2 is h.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.estimators.information import POWERLESS
from uav_ident_ros.identification.regression import Layout, RowSamples, diagonal
from uav_ident_ros.identification.scales import (
    BLOCKS,
    DOUBTLESS,
    INDEPENDENT_TIME,
    MEMORY,
    ROUNDING,
    SURE,
    TINY,
)
from uav_ident_ros.identification.structure import (
    MAIN_DERIVATIVES,
    ROWS,
    BoolArray,
    FloatArray,
)

LOADING = 1e-4
"""Added to the information, relative to its diagonal: the input and its square are collinear. A
factor of two hardly matters: of 30 flights with inputs 80 or 120 ms later than configured, the same
rows are denied. Without it 12 of their 90 rows stay usable; ten times as much hides a lag of 80 ms.
"""

EXTRA = 5
"""Number of additional regressors. They are tested in pairs: all need longer than a cold start has.
"""

PLAY = 1.0 / SURE
"""Half of the play that is looked for, relative to the input's rms. With half or with 1.5 times as
much, plays of 0.7 to 2 deg are found alike on five aircraft."""

_YAW, _SIDE_FORCE = ROWS.index("rdot"), len(ROWS)

_SATURATION, _LATENESS, _ATTENUATION, _BACKLASH, _SLOWNESS = range(EXTRA)
_LATE = (_SATURATION, _LATENESS), (_ATTENUATION, _LATENESS)
# Backlash and slowness look late: beside lateness noise hides them
_PAIRS = (*_LATE, (_ATTENUATION, _SLOWNESS), (_SATURATION, _BACKLASH))
_WITH_SATURATION = [i for i, pair in enumerate(_PAIRS) if _SATURATION in pair]
_SLOW, _LOOSE = len(_LATE), len(_LATE) + 1  # Pairs of slowness and backlash
_OTHERS = 1.0 - np.eye(len(ROWS))  # The other rows of each row


def sigma_without_error(sigma: FloatArray, value: FloatArray, share: FloatArray) -> FloatArray:
    """Return standard deviations without the model error, `share` relative to the value."""
    return np.asarray(np.sqrt(np.maximum(sigma**2 - (share * value) ** 2, 0.0)))


def known_inputs(
    coefficients: FloatArray,  # (R, n)
    sigma: FloatArray,  # (R, n)
    share: FloatArray,  # (3,) Model error of each row's main input, relative to its effect
    t_ratio: float = SURE,
) -> BoolArray:
    """Return which main control derivatives exceed this t-ratio, model errors excluded, (3,).

    A servo lag that is not configured is a model error, and makes no input unknown.
    """
    value, spread = coefficients[MAIN_DERIVATIVES], sigma[MAIN_DERIVATIVES]
    return np.asarray(np.abs(value) > t_ratio * sigma_without_error(spread, value, share))


class Losses(NamedTuple):
    """Losses of the inputs' effect by pairs of additional regressors, the second one late."""

    found: FloatArray  # (rows, pairs, 2) Relative to the effect, rms
    sure: FloatArray  # (rows, pairs, 2) The same, 0 where not significant
    sigma: FloatArray  # (rows, pairs, 2) Standard deviation of `found`
    rate: FloatArray  # (rows,) Rms rate of the input relative to its rms, rad/s
    size: FloatArray  # (rows, pairs, 2) Coefficients, 0 where not significant
    less: FloatArray  # (rows, pairs, 2) `found` less the most that feedback may cause
    # (rows,) Whether the input moved in more blocks than it makes regressors, as a scatter needs
    informative: BoolArray

    @property
    def saturation(self) -> tuple[FloatArray, FloatArray]:
        """Loss of each row by saturation, and its standard deviation, (rows,).

        The better determined solution counts. An effect that grows with the deflection, as by a
        dead band, counts alike. Saturation and backlash of opposite signs are nearly a straight
        line: then the rest counts.
        """
        curved, error = (a[:, _WITH_SATURATION, 0] for a in (self.found, self.sigma))
        backlash, size = self.found[:, _LOOSE, 1], np.abs(curved)
        straight = np.clip(-backlash * np.sign(curved[:, -1]), 0.0, size[:, -1])
        size[:, -1] -= straight
        better = range(len(error)), error.argmin(axis=1)
        return size[better], error[better]

    def beyond_chance(self, pair: int) -> FloatArray:
        """Return the loss by the second one of a pair beyond its own sigma, (rows,), 0 ... 1."""
        # The squares stay finite, also of an effect of zero.
        shares = np.array((self.found[:, pair, 1], self.sigma[:, pair, 1]))
        found, sigma = np.square(shares.clip(0.0, 1.0 / ROUNDING))
        return np.asarray(np.sqrt(np.clip(found - sigma, 0.0, 1.0)))


class ModelError:
    """Model error of the main input of each moment row, and height of the accelerometer."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        # Row, entry and moment row of each input that is looked at: the main ones, and in the row
        # of ay the rudder and the roll rate
        rolling = [[len(ROWS)], layout.rolling, [0]] if layout.rolling else np.empty((3, 0))
        self._rows, self._entries, self._moments = np.hstack((layout.surfaces, rolling)).astype(int)
        self._force = slice(_SIDE_FORCE, layout.surfaces.shape[1])
        self._force_is_known = False
        # Samples, and their weights (3,) times dt
        self._gathered: list[tuple[RowSamples, FloatArray]] = []
        # Of the newest blocks, cyclically, sums of z f^T, z z^T, z y and the squared residuals
        rows, width = len(self._rows), layout.width + EXTRA
        self._zf, self._zz = (np.zeros((rows, BLOCKS, width, width)) for _ in range(2))
        self._zy, self._squares = np.zeros((rows, BLOCKS, width)), np.zeros((rows, BLOCKS))
        self._blocks = 0  # Closed so far
        self._settled = 0  # Of these, the newest, with instruments of a known model
        # Of the inputs, in regressors and instruments, (2, rows): running mean, mean square, and
        # mean square of the rate; if the samples continue, the last one behind play and slow servo
        self._mean, self._square, self._speed = np.zeros((3, 2, rows))
        self._behind: FloatArray | None = None
        # Largest loss by saturation, lateness or attenuation, relative to the input's effect, rms,
        # at most 1; 0 where not significant
        self.share: FloatArray = np.zeros(len(ROWS))
        # Saturation, and the same by least squares once signals were injected
        self.saturation: FloatArray = np.zeros(len(ROWS))
        self._least_squares: ModelError | None = None
        # Loss by backlash or a limit of speed beyond its own sigma, rms, significant or not
        self._not_followed: FloatArray = np.zeros(len(ROWS))
        # Earliness of each row, its standard deviation, s, and the input's rate as in `Losses`
        self._early: FloatArray = np.zeros(len(ROWS))
        self._early_sigma: FloatArray = np.full(len(ROWS), np.inf)
        self._rate: FloatArray = np.zeros(len(ROWS))
        # Loss by lateness, significant or not, beyond what feedback may cause, and its precision,
        # 1 / sigma^2; those of before a row began anew, and the number of its blocks since
        self._lateness, self._held = np.zeros((2, 2, len(ROWS)))
        self._blocks_anew = np.full(len(ROWS), BLOCKS)
        # Loss by a limit of speed, as that by lateness, and its precision
        self._slowness: FloatArray = np.zeros((2, len(ROWS)))
        # Of the accelerometer above `imu.lever_arm`, m; 0 where not significant
        self.height = 0.0

    @property
    def lost(self) -> FloatArray:
        """Loss that sigma contains, relative to the input's effect, (3,)."""
        lost = np.maximum(self.share, self._not_followed)
        beside = self._least_squares
        return lost if beside is None else np.maximum(lost, beside.saturation)

    def relative_error(
        self,
        known: BoolArray,  # (3,) Rows whose main control derivative is known
        damping: FloatArray,  # (3,) Of the rows' own rates, 1/s
        delay: float = math.inf,  # Delay plus lag that the inputs have, s
        rotors: bool = False,  # Whether the vehicle flies by rotors alone
    ) -> FloatArray:
        """Return the most likely error of each row, (3,): `lost`, lateness or earliness.

        Lateness counts before it is significant: noise must not hide a servo that is too slow for
        its commands. Servos are mostly alike, and quick damping hides what they lose, so a row that
        may be as late or slow as the others are is taken to be so. Delay and lag are one setting
        for all inputs, and an error of it makes all of them early. The largest earliness of the
        rows `known` therefore counts for all, unless one of them would show it and shows none: by
        gusts one alone looks early. With the damping a, inputs that are early by T look early by T
        / (1 + a T). The yaw of a multirotor counts for itself alone: the inertia of the `rotors`
        turns the vehicle while their speed changes, before their drag does.

        No input acts before its command. It looks early by more than its `delay` because stamps are
        wrong, which all inputs share, or because gusts or a missing term look like it.
        """
        own = np.where(known & self._is_early, self._early, 0.0)
        told = known & (np.arange(len(ROWS)) != _YAW) if rotors else known
        shared, limit = np.where(told, own, 0.0).max(), SURE * self._early_sigma
        # The most that a row without earliness hides in its damping
        room = np.where(
            told & (self._early < limit), 1.0 / np.maximum(limit, TINY) - damping, 0.0
        ).max()
        hidden = 1.0 / room if room > 0.0 else math.inf
        if hidden < shared:
            shared = 0.0
        own = np.minimum(own, delay + hidden)
        early = np.maximum(own * self._rate, shared * self._rate.max())
        late = _as_others(self._lateness, self._rate, told)
        slow = _as_others(self._slowness, np.ones(len(ROWS)), told)
        lost = np.maximum.reduce((self.lost, self._late, late, slow))
        return np.maximum(lost, np.minimum(early, 1.0))

    @property
    def _late(self) -> FloatArray:
        """Most likely loss by lateness, (3,), 0 ... 1."""
        return np.asarray(np.clip(self._lateness[0], 0.0, 1.0))

    @property
    def is_known(self) -> BoolArray:
        """Whether there were enough blocks for the errors of each row, (3,)."""
        return np.isfinite(self._early_sigma)

    @property
    def _is_early(self) -> BoolArray:
        """Whether the earliness of each row is significant, (3,)."""
        return self._early > DOUBTLESS * self._early_sigma

    def begin_anew(self, row: int) -> None:
        """Clear the sums of a row whose derivatives are learned anew.

        Its errors hold until there are enough blocks again. Its lateness holds longer: delay and
        servo stay the same, and the lateness of a few blocks is noise.
        """
        self._gathered.clear()
        own = self._moments[: self._force.stop] == row
        for sums in (self._zf, self._zz, self._zy, self._squares):
            sums[: self._force.stop][own] = 0.0
        self._held[:, row], self._blocks_anew[row] = self._lateness[:, row], 0
        if self._least_squares:
            self._least_squares.begin_anew(row)

    def add(
        self,
        samples: RowSamples,
        weight: FloatArray,  # (3,) Weight of the samples in each row
        # (3,) q of each row's main input as in `Feedback`: feedback looks late
        ratio: FloatArray,
        # Of the aileron: the gust that it answers also pushes sideways
        roll_ratio: float,
        linear: FloatArray,  # (rows, c) Coefficients of the regression problem
        *,
        force_is_known: bool,  # Whether the rudder's side force is known; if not it tells nothing
        restarted: bool,  # Whether the first sample does not continue the last
        # Whether the instruments' model is known. At the start it leaks, and gusts are in them.
        # With enough blocks without leak, those of the start are left out.
        settled: bool = True,
        injected: bool = False,  # Whether the instruments are the response to injected signals
    ) -> None:
        """Add samples; they are evaluated in blocks of `INDEPENDENT_TIME`.

        Through a saturation the injected signal alone looks linear, if an autopilot moves the input
        far beyond: its answers act as a dither. The whole input shows the saturation, by least
        squares. The part of `u|u|` that is not linear in normally distributed signals has no
        correlation with a gust that they answer (Stein's lemma).
        """
        if injected and self._least_squares is None:
            self._least_squares = ModelError(self._layout)
        if self._least_squares:
            own = samples.by_regressors()
            self._least_squares.add(
                own, weight, ratio, roll_ratio, linear,
                force_is_known=force_is_known, restarted=restarted,
            )  # fmt: skip
        if restarted or not weight.any():
            self._gathered.clear()
            self._behind = None
        if not weight.any():
            return
        self._gathered.append((samples, samples.dt * weight))
        if sum(part.time for part, _ in self._gathered) < INDEPENDENT_TIME - 0.5 * samples.dt:
            return
        parts, weights = zip(*self._gathered, strict=True)
        self._gathered.clear()
        block = RowSamples.join(parts)
        rows, at = self._rows, self._blocks % BLOCKS
        weight = np.repeat(weights, [part.count for part in parts], axis=0).T[self._moments]
        weight[:, 0] = 0.0  # no derivative of the first sample
        f, z = self._extended(np.stack((block.f, block.z)), block.dt)
        weighted = (z * weight[:, :, None]).transpose(0, 2, 1)
        self._zf[:, at], self._zz[:, at] = weighted @ f, weighted @ z
        self._zy[:, at] = (weighted @ block.y[rows, :, None])[:, :, 0]
        self._squares[:, at] = np.add.reduce(weight * block.residual[rows] ** 2, axis=1)
        self._blocks += 1
        self._blocks_anew += 1
        self._settled += settled
        self._force_is_known = force_is_known
        effect = linear[rows, self._layout.index[rows, self._entries]]
        answers = ratio[self._moments]
        answers[self._force.stop :] = roll_ratio
        self._look(answers, effect)

    def _extended(self, regressors: FloatArray, dt: float) -> FloatArray:
        """Return regressors and instruments, (2, rows, m, k), extended by those of each input u.

        In the row of the side force, as the rudder's slope is there, they are the slopes of those.
        """
        own, at = regressors[:, self._rows], self._force
        moved = own[:, range(len(self._rows)), :, self._entries].swapaxes(0, 1)
        u = moved.copy()
        u[:, at] = u[:, self._moments[at]]
        beyond = self._beyond_servo(u, dt)
        extended = np.zeros((*u.shape, own.shape[-1] + EXTRA))
        extended[..., :-EXTRA] = own
        extra = extended[..., -EXTRA:]
        extra[..., _SATURATION] = u * np.abs(u)
        extra[:, at, :, _SATURATION] = 2.0 * np.abs(u[:, at]) * moved[:, at]
        before, now, after = moved[..., :-2], moved[..., 1:-1], moved[..., 2:]
        extra[..., 1:, _LATENESS] = (moved[..., 1:] - moved[..., :-1]) / dt
        extra[..., 1:-1, _ATTENUATION] = (2.0 * now - after - before) / dt**2
        extra[..., _BACKLASH:] = beyond
        extra[:, at, 1:, _BACKLASH:] = np.diff(beyond[:, at], axis=2) / dt
        extra[:, at, 0, _BACKLASH:] = 0.0
        return extended

    def _beyond_servo(self, u: FloatArray, dt: float) -> FloatArray:
        """Return inputs (2, rows, m) less what a servo makes of them, (2, rows, m, 2).

        The first servo has a play (the play operator), the second a limit of speed.
        """
        share = 1.0 / min(self._blocks + 1.0, MEMORY / INDEPENDENT_TIME)
        self._mean += share * (u.mean(axis=-1) - self._mean)
        self._square += share * (np.square(u).mean(axis=-1) - self._square)
        self._speed += share * (np.square(np.diff(u) / dt).mean(axis=-1) - self._speed)
        half = PLAY * np.sqrt(np.maximum(self._square - self._mean**2, 0.0))
        reach = np.sqrt(self._speed) * dt
        play, slow = (u[..., 0], u[..., 0]) if self._behind is None else self._behind
        beyond = np.empty((*u.shape, 2))
        for k in range(u.shape[-1]):
            now = u[..., k]
            play, slow = (
                np.clip(play, now - half, now + half),
                np.clip(now, slow - reach, slow + reach),
            )
            beyond[..., k, 0], beyond[..., k, 1] = now - play, now - slow
        self._behind = np.stack((play, slow))
        return beyond

    def _look(self, ratio: FloatArray, effect: FloatArray) -> None:
        """Evaluate all blocks, and earliness in those after the start, if these are enough.

        With a leaking model gusts are in the instruments, and the inputs appear to precede them.
        """
        count, k = min(self._blocks, BLOCKS), self._zy.shape[-1] - EXTRA + 2
        if count <= k:
            return  # too few blocks for a scatter
        losses = self._find(slice(count), _PAIRS, ratio, effect)
        moments = losses.informative[: len(ROWS)]
        self._follow_lateness(losses)
        rolls = slice(self._force.stop, None)
        if losses.informative[rolls].all():
            self.height = float(losses.size[rolls, 0, 1].sum())
        saturation, sure = self._saturated(losses), losses.sure[: len(ROWS)]
        taken = np.clip(np.stack((saturation, sure[:, 0, 1], sure[:, 1, 0])), 0.0, 1.0)
        self.share = np.where(moments, taken.max(axis=0), self.share)
        self.saturation = np.where(moments, taken[0], self.saturation)
        self._follow_servos(losses)
        newest = self._settled if k < self._settled < count else count
        blocks = np.arange(self._blocks - newest, self._blocks) % BLOCKS
        self._follow_earliness(self._find(blocks, _LATE[:1], ratio, effect, loading=ROUNDING))

    def _better(self, losses: Losses, error: FloatArray) -> NDArray[np.intp]:
        """Return the row of each moment's losses, (3,): of yaw that with the smaller `error`.

        Where nearly all of the rudder's moment is by its side force, noise hides the rest.
        """
        rows = np.arange(len(ROWS))
        if self._is_shown_by_force(losses) and error[_SIDE_FORCE] < error[_YAW]:
            rows[_YAW] = _SIDE_FORCE
        return rows

    def _is_shown_by_force(self, losses: Losses) -> bool:
        """Return whether the rudder's side force is known and informative."""
        return self._force_is_known and bool(losses.informative[_SIDE_FORCE])

    def _saturated(self, losses: Losses) -> FloatArray:
        """Return the loss of each row by saturation, (3,).

        If one input in ten saturates, at three sigma a saturation is more likely than none. Where
        all others saturate, an input does so as likely as not: then its likeliest loss counts.
        """
        likely, sigma = losses.saturation
        sure = np.where(likely > SURE * sigma, likely - sigma, 0.0)
        if self._is_shown_by_force(losses):
            sure[_YAW] = sure[[_YAW, _SIDE_FORCE]].max()
        likely, sure = likely[: len(ROWS)], sure[: len(ROWS)]
        saturates = losses.informative[: len(ROWS)] & (sure > 0.0)
        return np.where(saturates | (_OTHERS @ ~saturates > 0.0), sure, likely)

    def _follow_servos(self, losses: Losses) -> None:
        """Take over backlash and slowness."""
        moments = losses.informative[: len(ROWS)]
        loose, slow = (self._better(losses, losses.sigma[:, i, 1]) for i in (_LOOSE, _SLOW))
        lost = np.maximum(losses.beyond_chance(_LOOSE)[loose], losses.beyond_chance(_SLOW)[slow])
        self._not_followed = np.where(moments, lost, self._not_followed)
        precision = 1.0 / np.maximum(np.square(losses.sigma[slow, _SLOW, 1]), ROUNDING)
        slowness = losses.less[slow, _SLOW, 1], precision
        self._slowness = np.where(moments, slowness, self._slowness)

    def _follow_lateness(self, losses: Losses) -> None:
        """Take over the lateness, averaged with that of before the rows began anew.

        Both are weighted by their precision (inverse-variance weighting). The former leaves with
        time as its blocks would have.
        """
        rows = np.arange(len(losses.sigma))
        pair = losses.sigma[:, : len(_LATE), 1].argmin(axis=1)
        found, sigma = losses.less[rows, pair, 1], losses.sigma[rows, pair, 1]
        better = self._better(losses, sigma)
        precision = 1.0 / np.maximum(np.square(sigma[better]), ROUNDING)
        late, held = self._held
        held = held * np.maximum(1.0 - self._blocks_anew / BLOCKS, 0.0)
        both = held + precision
        mean = (held * late + precision * found[better]) / both
        moments = losses.informative[: len(ROWS)]
        self._lateness = np.where(moments, (mean, both), self._lateness)

    def _follow_earliness(self, losses: Losses) -> None:
        """Take over the earliness; keep a significant one unless these losses refute it.

        They do where they would show it significantly, and are nearer to none. Without that the few
        blocks after the start would clear what all together had shown.
        """
        rows = slice(len(ROWS))
        rate = losses.rate[rows]
        found, sigma = -losses.found[rows, 0, 1] / rate, losses.sigma[rows, 0, 1] / rate
        refuted = (self._early > SURE * sigma) & (self._early > 2.0 * found)
        taken = losses.informative[rows] & (
            (losses.sure[rows, 0, 1] != 0.0) | refuted | ~self._is_early
        )
        self._early = np.where(taken, found, self._early)
        self._early_sigma = np.where(taken, sigma, self._early_sigma)
        self._rate = np.where(taken, rate, self._rate)

    def _find(
        self,
        blocks: NDArray[np.intp] | slice,
        pairs: Sequence[tuple[int, int]],
        ratio: FloatArray,
        effect: FloatArray,
        loading: float = LOADING,  # Relative to the diagonal of the information
    ) -> Losses:
        """Return the losses by pairs of the additional regressors.

        They are solved in units of rms and tested by their sigma. A loading makes them less noisy
        (ridge regression; Hoerl and Kennard 1970). Where damping is as quick as the input it also
        draws the row's own coefficients to zero, and the input's slope takes their place: healthy
        elevators then look 40 ms early, significantly. Earliness is therefore solved without one.
        """
        zf, zz, zy = (sums[:, blocks] for sums in (self._zf, self._zz, self._zy))
        count, width = zy.shape[1:]
        model = width - EXTRA
        kept = [[*range(model), model + first, model + second] for first, second in pairs]
        pick = np.eye(width)[kept]  # (pairs, k, width)
        total_zf, total_zz, total_zy = (np.add.reduce(sums, axis=1) for sums in (zf, zz, zy))
        scale, instruments, gain, linear = _solved(total_zf, total_zz, total_zy, pick, loading)
        gain, k = gain[..., -2:, :], pick.shape[1]
        # A block's score, sum of z e, is linear in the coefficients.
        solved = (linear * scale)[..., None, :] @ pick
        explained = zf.reshape(len(zf), 1, -1, width) @ solved.swapaxes(-1, -2)
        scores = zy[:, None] - explained.reshape(len(zf), -1, count, width)
        scatter = scores @ (gain * scale[..., None, :] @ pick).swapaxes(-1, -2)
        # Blocks count as the input moved in them (the effective sample size; Kish 1965).
        moved = zz[range(len(zz)), :, self._entries, self._entries]
        shares = moved / np.maximum(moved.sum(axis=1, keepdims=True), POWERLESS)
        squared = np.square(shares.sum(axis=1))
        effective = squared / np.maximum(np.square(shares).sum(axis=1), ROUNDING)
        made = k - model + 1  # Of the input: itself, and the additional ones
        informative = effective > made
        lost = np.maximum(k / (count - k), made / np.where(informative, effective - made, 1.0))
        variance = (1.0 + lost[:, None, None]) * np.add.reduce(scatter**2, axis=2)
        # Feedback looks like any of them: small deflections answer gusts, large ones a reference.
        answers = ratio * np.add.reduce(self._squares[:, blocks], axis=1)
        spread = np.add.reduce(gain @ instruments * gain, axis=-1)
        answered = answers[:, None, None] * spread
        variance += answered
        # Without a prior this regression does not determine the input's own effect where a loop
        # moves it with the flow, or about one large deflection, as at another speed.
        extra, whole = linear[..., -2:], linear[range(len(zf)), :, self._entries][..., None]
        own = slice(self._force.stop)
        main = scale[range(self._force.stop), :, self._entries[own]]
        whole[own, :, 0] = effect[own, None] / main
        away = np.divide(-extra, whole, out=np.zeros_like(extra), where=whole != 0.0)
        alike = self._alike(scale)
        away *= alike
        sure = extra**2 > DOUBTLESS**2 * variance
        size = np.where(sure, extra * scale[..., -2:], 0.0)
        main_effect = np.maximum(np.abs(whole[..., 0]), POWERLESS)
        bias, error = (alike * np.sqrt(v) / main_effect[..., None] for v in (answered, variance))
        rate = scale[range(len(zf)), 0, self._entries] / scale[:, 0, -1]
        return Losses(away, np.where(sure, away, 0.0), error, rate, size, away - bias, informative)

    def _alike(self, scale: FloatArray) -> FloatArray:
        """Return the factors from a share of each row's effect to one of its moment.

        The array is (rows, pairs, 2). The side force follows the rudder's slope: of that the same
        coefficient is another share, rms.
        """
        shares = scale[range(len(scale)), :, self._entries][..., None] / scale[..., -2:]
        alike, of_moment = np.ones_like(shares), self._moments[self._force]
        alike[self._force] = shares[of_moment] / np.maximum(shares[self._force], TINY)
        return alike


def _as_others(
    loss: FloatArray,  # (2, 3) Of each row, and its precision, 1 / sigma^2
    rate: FloatArray,  # (3,) Loss of each row by the same servo, relative
    told: BoolArray,  # (3,) Rows that tell of the others
) -> FloatArray:
    """Return the loss by servos as in the other rows, in the mean, (3,), 0 ... 1.

    A row counts by its precision. No row loses more than its own evidence allows.
    """
    found, precision = loss[0].clip(-1.0 / ROUNDING, 1.0 / ROUNDING), loss[1]
    weight = _OTHERS * (rate * precision * told)  # Of the others in each row
    mean = weight @ found / np.maximum(weight @ rate, TINY)
    highest = found + SURE / np.sqrt(np.maximum(precision, TINY))
    return np.asarray(np.minimum(rate * mean, highest).clip(0.0, 1.0))


def _solved(
    zf: FloatArray,  # zf, zz: (rows, w, w), zy: (rows, w) Sums of all blocks
    zz: FloatArray,
    zy: FloatArray,
    pick: FloatArray,  # (pairs, k, w) Selects the regressors that are solved for
    loading: float,  # Relative to the diagonal of the information
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the solution of rows with some of their regressors.

    Returned are the scale, one over rms and root of time, (rows, pairs, k); the scaled
    ``sum z z^T`` and the gain from the scaled ``sum z y``, (rows, pairs, k, k); and the
    coefficients.
    """
    slope, instruments = (pick @ sums[:, None] @ pick.swapaxes(-1, -2) for sums in (zf, zz))
    power = diagonal(instruments)
    scale = 1.0 / np.sqrt(np.where(power > POWERLESS, power, 1.0))
    both = scale[..., :, None] * scale[..., None, :]
    load = loading * np.eye(pick.shape[1])
    slope, instruments = slope * both, instruments * both + load
    projected = np.linalg.solve(instruments, slope).swapaxes(-1, -2)
    gain = np.linalg.solve(projected @ slope + load, projected)
    product = scale[..., None] * (pick @ zy[:, None, :, None])
    return scale, instruments, gain, (gain @ product)[..., 0]
