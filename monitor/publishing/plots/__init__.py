"""Plots of results, written as image files or embedded as SVG elements in HTML reports."""
