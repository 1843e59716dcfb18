"""Plots as image files and as SVG elements of HTML reports."""
