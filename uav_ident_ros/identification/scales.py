# SPDX-License-Identifier: Apache-2.0
"""Scales of time and of chance that parts of the core share."""

from statistics import NormalDist

import numpy as np

STEP = 0.025
"""Step of all integration in flight, s: a motion of 10 rad/s turns by a quarter of a radian in it,
and straight lines between the steps are off by less than a percent."""

SAMPLE_TIME = 2.0 * STEP
"""Time over which filtered signals are averaged, s: the regression's filter leaves nothing quicker.
"""

LOOK_TIME = 0.25
"""Time between two looks at what changes slowly, s."""

GUST_TIME = 0.3
"""Time constant with which gusts come and go, s."""

INDEPENDENT_TIME = 1.0
"""Time after which residuals count as independent, s: longer than the correlation of gusts and of
the regression's filter."""

RESPONSE_TIME = 2.0
"""Time in which an aircraft answers an input, s: a few periods of the short modes."""

SHORT_MEMORY = 10.0
"""Memory of a running mean square, s: that of the residuals weighs the prior, that of the rates
what a model may answer. In it least squares builds the first model."""

START_TIME = 2.0 * SHORT_MEMORY
"""Time of learning for which the coefficients of a cold start count as poor, s: the model leaks,
and every tick is learned from at once."""

MEMORY = 30.0
"""Memory of what describes the flight of late, s: noise, fit, usual slopes."""

LONG_MEMORY = 2.0 * MEMORY
"""Memory of what is usual, s: a flight has its calm and its lively parts within a minute."""

BLOCKS = round(LONG_MEMORY / INDEPENDENT_TIME)
"""Blocks of a flight that are judged, the newest: the share of one in the scatter is small."""

SURE = 3.0
"""Standard deviations from which something is no chance."""

DOUBTLESS = -NormalDist().inv_cdf(NormalDist().cdf(-SURE) / BLOCKS)
"""The same, 4.1, where each of `BLOCKS` brings a new look: together they are no more often wrong
(Bonferroni)."""

OUTLYING = SURE**2
"""Square, relative to its variance or mean, from which samples count less."""

TINY = float(np.finfo(float).tiny)
"""Smallest number that is not nothing; added to what may be zero where it is divided by."""

ROUNDING = float(np.finfo(float).eps) ** 0.5
"""Relative size of what is nothing: far above rounding, far below all that is measured."""

IN_A_ROW = 5
"""Samples in a row that are no chance: a gyro is saturated, a clock has jumped, inputs are lost."""
