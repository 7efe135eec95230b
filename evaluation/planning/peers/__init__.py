"""Other people's planners, each run by its own Python, driven in our closed loop (`docs/planning.md`)."""
