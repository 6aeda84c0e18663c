# SPDX-License-Identifier: Apache-2.0
"""Online identification of attitude dynamics: the core, NumPy alone."""
