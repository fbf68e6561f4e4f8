"""Orientation."""
