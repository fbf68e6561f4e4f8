"""Inertial."""
