"""Fuzz targets. Each module contains the targets of one kind of reader."""
