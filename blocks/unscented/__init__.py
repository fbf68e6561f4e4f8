"""Unscented."""
