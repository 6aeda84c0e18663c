# SPDX-License-Identifier: Apache-2.0
"""Layouts for PlotJuggler and Foxglove, made from one declaration of the plots."""
