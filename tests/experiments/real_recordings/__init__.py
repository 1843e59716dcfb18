"""`reconcile` on real recordings, with an independent check of each finding."""
