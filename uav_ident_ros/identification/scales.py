# SPDX-License-Identifier: Apache-2.0
"""Scales of time and of chance that parts of the core share."""

LOOK_TIME = 0.25
"""Time between two looks at what changes slowly, s."""

INDEPENDENT_TIME = 1.0
"""Time after which residuals count as independent, s: longer than the correlation of gusts and of
the regression's filter."""

SHORT_MEMORY = 10.0
"""Memory of a running mean square, s: that of the residuals weighs the prior, that of the rates
what a model may answer."""

MEMORY = 30.0
"""Memory of what describes the flight of late, s: noise, fit, usual slopes."""

LONG_MEMORY = 60.0
"""Memory of what is usual, s: a flight has its calm and its lively parts within a minute."""

SURE = 3.0
"""Standard deviations from which something is no chance."""

OUTLYING = SURE**2
"""Square, relative to its variance or mean, from which samples count less."""

IN_A_ROW = 5
"""Samples in a row that are no chance: a gyro is saturated, a clock has jumped, inputs are lost."""
