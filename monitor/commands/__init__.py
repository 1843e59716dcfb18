"""The work of each command on recordings and configurations: ``analyze``, ``simulate``, ``reconcile`` and others."""
