# SPDX-License-Identifier: Apache-2.0
"""A terminal view of a running identifier: what it has learned, how well, and what it waits for."""
