# SPDX-License-Identifier: Apache-2.0
"""MCAP bags: read, written, saved where damaged."""
