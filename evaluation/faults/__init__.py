"""Faults on purpose, in real processes on a real router, and what the vehicle hears meanwhile: `make faults`."""
