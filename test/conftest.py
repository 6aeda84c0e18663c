# SPDX-License-Identifier: Apache-2.0
"""For all tests: the package says how many threads BLAS gets, so it must load before NumPy."""

import signal

import uav_ident_ros  # noqa: F401

# A shell starts what it runs in the background with SIGINT ignored, and every child inherits
# that: the programs under test could not be interrupted.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
