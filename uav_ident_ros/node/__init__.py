# SPDX-License-Identifier: Apache-2.0
"""The node `identifier`: topics, services, parameters, diagnostics, state file."""
