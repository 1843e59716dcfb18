"""Unattended operation of the service: limits, hooks, metrics, systemd notification and live reconciliation."""
