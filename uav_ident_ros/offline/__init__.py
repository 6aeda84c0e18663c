# SPDX-License-Identifier: Apache-2.0
"""The identifier over a bag, as the node would have run it."""
