"""Entry point of ``python -m monitor.cli``."""

from imu_monitor import main

main()
