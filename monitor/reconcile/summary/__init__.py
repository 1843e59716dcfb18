"""Ranking of the findings by the share of the gap, and summary of a reconciliation in a few sentences."""
