"""What is timed. Each function runs in a process of its own; arguments and results are JSON."""
