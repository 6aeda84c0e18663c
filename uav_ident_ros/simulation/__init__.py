# SPDX-License-Identifier: Apache-2.0
"""Simulated flights with known truth, to make bags, tests and benchmarks from."""
