"""Diagnostics and IMU samples for ROS 2 over zenoh, in the form that rmw_zenoh expects."""
