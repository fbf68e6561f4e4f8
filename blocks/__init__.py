"""The block library: signals, inertial navigation, aiding, particles, sensors, worlds and recorded flights.

Import what you need from its modules: `from flowgraph.blocks.inertial.imu import predict`.
"""
