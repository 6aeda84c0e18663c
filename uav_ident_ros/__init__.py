# SPDX-License-Identifier: Apache-2.0
"""Online identification of the attitude dynamics of unmanned aircraft, for ROS 2."""

import os

# The matrices here are ten by ten: handing them to threads costs a hundred times the
# arithmetic. It must be said before NumPy loads; whoever has set it keeps the last word.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.1.0"
