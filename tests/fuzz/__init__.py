"""Mutated files for every reader and mad arguments for every kernel; `make fuzz` runs them for a bounded time."""
