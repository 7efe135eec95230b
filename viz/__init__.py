"""Zenoh to Rerun: what the services see and decide, live and as recordings."""
