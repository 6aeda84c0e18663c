# SPDX-License-Identifier: Apache-2.0
"""A terminal view of a running identifier: coefficients, fit, verdict, and missing inputs."""
