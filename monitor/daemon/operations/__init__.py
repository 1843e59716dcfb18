"""Unattended operation: limits, hooks, metrics, systemd and the reconcile command of a running service."""
