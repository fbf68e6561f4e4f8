"""What a graph becomes."""
