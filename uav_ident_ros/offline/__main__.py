# SPDX-License-Identifier: Apache-2.0
"""``python -m uav_ident_ros.offline``."""

import sys

from uav_ident_ros.offline import main

if __name__ == "__main__":
    sys.exit(main())
