"""Entry point of ``python -m imu_monitor``."""

from imu_monitor import main

main()
