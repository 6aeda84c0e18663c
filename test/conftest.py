# SPDX-License-Identifier: Apache-2.0
"""For all tests: the package says how many threads BLAS gets, so it must load before NumPy."""

import uav_ident_ros  # noqa: F401
