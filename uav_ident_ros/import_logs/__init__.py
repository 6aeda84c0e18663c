# SPDX-License-Identifier: Apache-2.0
"""Autopilot logs and tables in, bags with the standard topics and fitting parameters out."""
