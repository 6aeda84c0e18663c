# SPDX-License-Identifier: Apache-2.0
"""`report.html`: the results of a flight on one page, for any browser."""
