"""Writing down what a step does."""
