# SPDX-License-Identifier: Apache-2.0
"""Autopilot logs and tables in, bags with the standard topics and fitting parameters out.

A log that cannot be imported raises `flight_log.ImportLogError`, whoever finds out.
"""
