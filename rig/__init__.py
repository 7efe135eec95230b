"""The bench: sources of a world, the simulated vehicle, the launcher, the `forefield` command."""
