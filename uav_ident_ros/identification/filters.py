# SPDX-License-Identifier: Apache-2.0
"""Linear filters, discretised exactly and applied to a block of samples at once.

A block of m cells of width h takes one matrix product instead of m recursions: the outputs are
``C A^i s + sum_j C A^(i-j) B v_j``, with precomputed factors.
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.structure import FloatArray

BLOCK = 64
"""Cells in one matrix product; longer blocks are split. It limits the memory, and does not affect
results beyond rounding."""


def expm(matrix: FloatArray) -> FloatArray:
    """Return the exponential of a small matrix, by scaling, a Taylor series and squaring."""
    norm = float(np.abs(matrix).sum(axis=1).max())
    squarings = max(0, int(np.ceil(np.log2(norm))) + 2) if norm > 0.0 else 0
    scaled = matrix / 2.0**squarings
    result = np.eye(len(matrix))
    term = np.eye(len(matrix))
    # 18 terms of a matrix of norm 1/4 leave a remainder below 1e-26.
    for k in range(1, 19):
        term = term @ scaled / k
        result = result + term
    for _ in range(squarings):
        result = result @ result
    return result


def discretised(
    a: FloatArray, b: FloatArray, h: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B0 and B1 of ``s+ = A s + B0 left + B1 right`` for ``s_dot = a s + b v``.

    The input v is linear in time over a cell of `h` s, with the values left and right at its ends;
    if it is held, they are the same. The exponential of the augmented matrix gives the exact
    solution (Van Loan 1978). The shapes are those of a (d, d) and b (d,).
    """
    d = len(a)
    augmented = np.zeros((d + 2, d + 2))
    augmented[:d, :d] = a * h
    augmented[:d, d] = b * h
    augmented[d, d + 1] = 1.0
    e = expm(augmented)
    constant, slope = e[:d, d], e[:d, d + 1]
    return e[:d, :d], constant - slope, slope


def low_pass(cutoff: float) -> tuple[FloatArray, FloatArray]:
    """Return a and b of a Butterworth low-pass of second order, ``s = [output, derivative]``.

    The cut-off is in rad/s.
    """
    a = np.array([[0.0, 1.0], [-(cutoff**2), -np.sqrt(2.0) * cutoff]])
    return a, np.array([0.0, cutoff**2])


class BlockFilter:
    """Filter of N channels by one linear system of d states, block by block."""

    def __init__(
        self,
        # ``s_dot = a s + b v``, 1/s
        a: FloatArray,  # (d, d)
        b: FloatArray,  # (d,)
        h: float,  # Cell width, s
        channels: int,
    ) -> None:
        a, *ends = discretised(a, b, h)
        d = len(a)
        self.state: FloatArray = np.zeros((d, channels))
        powers = np.empty((BLOCK + 1, d, d))
        powers[0] = np.eye(d)
        for i in range(BLOCK):
            powers[i + 1] = a @ powers[i]
        # free[c, i]: state component c after i + 1 cells, from the state at the start.
        free = powers[1:].transpose(1, 0, 2)
        left, right = (self._forced(powers, end) for end in ends)
        self._response = (free, left, right)
        self._kernels: dict[int, FloatArray] = {}

    @staticmethod
    def _forced(powers: FloatArray, b: FloatArray) -> FloatArray:
        """Return lower-triangular Toeplitz matrices of the impulse response, shape (d, m, m)."""
        impulse = powers[:-1] @ b
        d = len(b)
        forced = np.zeros((d, BLOCK, BLOCK))
        for i in range(BLOCK):
            forced[:, i, : i + 1] = impulse[i::-1].T
        return forced

    def apply(
        self,
        lines: FloatArray,  # (m + 1, N) Inputs at the cells' edges, linear between them
        held: FloatArray,  # (m, N) Inputs that are constant over the cells
    ) -> FloatArray:
        """Advance over m cells, with the sum of both inputs.

        Returns the states at the right end of each cell, (d, m, N).
        """
        parts, (d, channels) = [], self.state.shape
        for start in range(0, len(held), BLOCK):
            u = held[start : start + BLOCK]
            m = len(u)
            if m not in self._kernels:  # from initial state and inputs over m cells to the states
                free, left, right = self._response
                kernel = np.zeros((d, m, d + m + 1 + m))
                kernel[..., :d] = free[:, :m]
                kernel[..., d : d + m] = kernel[..., d + m + 1 :] = left[:, :m, :m]
                kernel[..., d + 1 : d + m + 1] += right[:, :m, :m]
                kernel[..., d + m + 1 :] += right[:, :m, :m]
                self._kernels[m] = kernel.reshape(d * m, -1)
            known = np.concatenate((self.state, lines[start : start + m + 1], u))
            states = (self._kernels[m] @ known).reshape(d, m, channels)
            self.state = states[:, -1].copy()
            parts.append(states)
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
