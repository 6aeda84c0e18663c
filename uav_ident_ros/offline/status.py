# SPDX-License-Identifier: Apache-2.0
"""Exit status and defaults of `replay`: what its help says, without what its work needs."""

NODE_NAME = "/identifier"

USABLE, NOT_USABLE, NO_RESULT = 0, 1, 2
"""Exit status: what scripts are told."""
