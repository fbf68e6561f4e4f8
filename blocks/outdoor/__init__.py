"""Outdoor."""
