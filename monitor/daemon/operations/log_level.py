"""Log level of the process, which also applies to existing loggers."""

import logging

import structlog


def set_log_level(name: str) -> None:
    """Set the log level of this process: "debug", "info", "warning", "error" or "critical"."""
    level = logging.getLevelNamesMapping()[name.upper()]
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(level))
