"""Links move bytes and know no IMU: one file each, see ``base`` for what one is."""
