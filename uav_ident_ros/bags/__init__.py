# SPDX-License-Identifier: Apache-2.0
"""Reading, writing and salvage of bags."""
