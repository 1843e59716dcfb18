"""Commands that process recordings and configurations, for example ``analyze``, ``simulate`` and ``reconcile``."""
