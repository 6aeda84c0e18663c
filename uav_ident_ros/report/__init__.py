# SPDX-License-Identifier: Apache-2.0
"""`report.html`: what a flight has shown, on one page that needs nothing but a browser."""
