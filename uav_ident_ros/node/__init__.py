# SPDX-License-Identifier: Apache-2.0
"""The node `identifier` and what belongs to it alone."""
