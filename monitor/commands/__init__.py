"""Commands on recordings and configurations: ``analyze``, ``simulate``, ``reconcile`` and others."""
