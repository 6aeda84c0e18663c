# SPDX-License-Identifier: Apache-2.0
"""Time constants and statistical thresholds that modules of the core share."""

from statistics import NormalDist

import numpy as np

STEP = 0.025
"""Integration step in flight, s. A motion of 10 rad/s turns by a quarter of a radian in it; the
error of straight lines between steps is below a percent."""

SAMPLE_TIME = 2.0 * STEP
"""Averaging time of filtered signals, s: the regression's filter removes all faster motion."""

LOOK_TIME = 0.25
"""Interval between evaluations of slow quantities, such as sigma and change detection, s."""

GUST_TIME = 0.3
"""Correlation time of gusts, s."""

INDEPENDENT_TIME = 1.0
"""Time between independent residuals, s: longer than the correlation of gusts and of the
regression's filter."""

RESPONSE_TIME = 2.0
"""Duration of an aircraft's response to an input, s: a few periods of the short modes."""

SHORT_MEMORY = 10.0
"""Memory of running mean squares, s. That of the residuals weighs the prior, that of the rates
limits the model's response. It is also the time of the first least-squares fit."""

START_TIME = 2.0 * SHORT_MEMORY
"""Time of learning during which the coefficients of a cold start are poor, s: the model leaks, and
each tick updates the estimate."""

MEMORY = 30.0
"""Memory of statistics of the recent flight, s: noise, fit, usual slopes."""

LONG_MEMORY = 2.0 * MEMORY
"""Memory of long-term statistics, s: a minute of flight has calm and lively parts."""

BLOCKS = round(LONG_MEMORY / INDEPENDENT_TIME)
"""Number of newest one-second blocks that statistics use: one block is a small share of the
scatter."""

GRAVITY_BAND = 0.3
"""Relative difference from gravity of a specific force that does not show its direction. In the
attitude's correction the weight falls linearly up to it."""

SURE = 3.0
"""Number of standard deviations that counts as significant."""

DOUBTLESS = -NormalDist().inv_cdf(NormalDist().cdf(-SURE) / BLOCKS)
"""The same for `BLOCKS` repeated tests, 4.1: together they have the false-alarm rate of one test at
`SURE` (Bonferroni)."""

OUTLYING = SURE**2
"""Square of a sample, relative to its variance or mean, from which it is an outlier."""

TINY = float(np.finfo(float).tiny)
"""Smallest positive number, added to denominators that may be zero."""

ROUNDING = float(np.finfo(float).eps) ** 0.5
"""Relative size that counts as zero: far above rounding, far below every measurement."""

REST_SWAY = 0.01
"""Swing of the rates of an aircraft at rest, rad/s: wind and an idling engine rock it."""

IN_A_ROW = 5
"""Number of consecutive samples that confirm a saturated gyro, a clock jump or lost inputs."""
