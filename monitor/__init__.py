"""Numbers to meaning: noise models, estimation, and what is published of it."""
