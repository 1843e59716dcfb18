"""Implementation of the commands that process recordings and configurations, such as ``analyze`` and ``simulate``."""
