"""Figures in PNG format."""
