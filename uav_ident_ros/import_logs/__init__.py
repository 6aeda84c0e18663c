# SPDX-License-Identifier: Apache-2.0
"""Import of autopilot logs and tables: a bag with the standard topics, and parameters for it.

Every module raises `log.ImportLogError` for a log that cannot be imported.
"""
