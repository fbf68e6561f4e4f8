"""Kalman."""
