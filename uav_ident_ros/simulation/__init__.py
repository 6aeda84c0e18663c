# SPDX-License-Identifier: Apache-2.0
"""Simulated flights with known truth, for bags, tests and benchmarks."""
